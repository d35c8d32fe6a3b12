"""From a bag to a network."""

__all__ = ["offer", "play"]
