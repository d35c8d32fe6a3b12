"""Trajectories, the planner and goals."""

__all__ = [
    "command_check",
    "goal_book",
    "goal_codec",
    "goals",
    "line",
    "path_timing",
    "planner",
    "planning",
    "player",
    "supervision",
    "trajectory",
]
