"""Arms that are files of somebody else, as bodies."""

__all__ = ["arm", "model", "robot"]
