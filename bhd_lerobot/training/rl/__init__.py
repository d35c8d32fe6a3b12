"""Reinforcement learning."""

__all__ = [
    "checkpoint",
    "config",
    "environment",
    "features",
    "learner",
    "log",
    "parts",
    "train",
    "validation",
]
