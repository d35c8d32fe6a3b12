"""`bhd-monitor`: a run as it goes on, in the terminal."""

__all__ = ["monitor", "state", "view"]
