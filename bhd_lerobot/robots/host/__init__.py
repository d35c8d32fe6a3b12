"""n robots of one kind under one cerebellum, in this process or in others."""

__all__ = [
    "checked_plant",
    "config",
    "frames",
    "host",
    "link",
    "process",
    "realtime",
    "robots",
    "simulation",
    "state",
]
