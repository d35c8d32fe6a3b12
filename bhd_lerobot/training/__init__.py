"""`bhd-train`: LeRobot's training with our loader and loop."""

__all__ = [
    "arguments",
    "checkpoint",
    "config",
    "dagger",
    "data",
    "env",
    "log",
    "loop",
    "output",
    "plots",
    "rl",
    "setup",
    "step",
    "summary",
    "train",
]
