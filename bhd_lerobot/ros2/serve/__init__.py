"""A robot of ours, on the wall clock, as a ROS 2 robot."""

__all__ = [
    "arm",
    "articles",
    "base",
    "bridge",
    "config",
    "description",
    "extras",
    "foxglove",
    "goals",
    "interface",
    "paths",
    "serve",
    "server",
    "setpoints",
    "trajectory",
]
