"""Datasets and policies on the Hub: the card, and the command that repeats a run."""

__all__ = ["card", "preview", "push", "transfer"]
