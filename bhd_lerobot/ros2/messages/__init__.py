"""Messages and what they mean for a robot."""

__all__ = [
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
    "table",
    "types",
    "ur",
    "views",
]
