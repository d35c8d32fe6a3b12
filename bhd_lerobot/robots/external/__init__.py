"""Any other LeRobot robot: its calls on an absolute grid of time, and a gate in front of them."""

__all__ = [
    "config",
    "device",
    "frames",
    "gate",
    "host",
    "lock",
    "make",
]
