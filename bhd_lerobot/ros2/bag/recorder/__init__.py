"""From a network to a bag."""

__all__ = ["receive", "record"]
