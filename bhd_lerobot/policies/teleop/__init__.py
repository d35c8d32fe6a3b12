"""A person in the place of a brain, through any LeRobot teleoperator."""

__all__ = [
    "brain",
    "calls",
    "config",
    "mapping",
    "takeover",
]
