"""Programs for people: the viewer, the monitor and the doctor."""

__all__ = ["doctor", "monitor", "view"]
