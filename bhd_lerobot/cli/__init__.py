"""The command lines; nothing imports them."""

__all__ = [
    "bag",
    "data",
    "doctor",
    "evaluate",
    "monitor",
    "network",
    "record",
    "replay",
    "ros2",
    "serve",
    "start",
    "train",
]
