"""Programs for people: the viewer, the monitor, the doctor and the demo."""

__all__ = ["demo", "doctor", "monitor", "view"]
