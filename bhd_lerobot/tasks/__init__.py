"""What is to be achieved, judged on the truth of the simulator."""

__all__ = [
    "avoid",
    "faults",
    "fetch",
    "free",
    "geodesic",
    "navigate",
    "operator",
    "pick",
    "reach",
    "sensing",
    "task",
    "variation",
]
