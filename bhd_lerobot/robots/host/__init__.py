"""n robots of one kind under one cerebellum, in this process or in others."""

__all__ = [
    "checked_plant",
    "config",
    "frames",
    "host",
    "link",
    "plant_loop",
    "plant_process",
    "plant_stop",
    "process",
    "realtime",
    "remote_plant",
    "robots",
    "sender",
    "simulation",
    "state",
]
