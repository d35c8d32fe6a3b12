"""Brain, hand, data: simulated robots, a fixed-rate cerebellum and crash-safe datasets for LeRobot."""

__version__ = "0.2.0"
