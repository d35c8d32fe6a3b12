"""Messages and what they mean for a robot."""

__all__ = [
    "arm",
    "base",
    "definitions",
    "fields",
    "images",
    "mapping",
    "parts",
    "presets",
    "robot_views",
    "scan",
    "serialize",
    "split",
    "types",
    "ur",
    "views",
]
