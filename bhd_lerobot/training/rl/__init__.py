"""Reinforcement learning."""

__all__ = ["config", "environment", "learner", "parts", "run", "train"]
