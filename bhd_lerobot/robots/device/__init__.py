"""A LeRobot robot as the plant of an arm: its blocking calls in a process of their own, below the cerebellum."""

__all__ = ["plant", "process", "units"]
