"""Messages and what they mean for a robot."""

__all__ = ["arm", "base", "images", "parts", "serialize", "split", "types", "views"]
