"""Takeovers of a learner by a rule."""

__all__ = ["brain", "takeover"]
