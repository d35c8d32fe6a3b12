"""Rules that drive an arm."""

__all__ = ["goal_brain", "grasp", "pick", "reach", "servo", "skills"]
