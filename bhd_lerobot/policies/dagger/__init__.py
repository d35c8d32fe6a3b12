"""Takeovers of a learner by a rule."""

__all__ = ["brain", "goal_expert", "takeover"]
