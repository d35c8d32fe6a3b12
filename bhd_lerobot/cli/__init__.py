"""The command lines; nothing imports them."""

__all__ = ["data", "start", "train"]
