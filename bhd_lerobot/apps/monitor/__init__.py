"""`bhd-monitor`: a run as it continues, in the terminal."""

__all__ = ["monitor", "page", "state", "view"]
