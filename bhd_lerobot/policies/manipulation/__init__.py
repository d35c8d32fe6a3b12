"""Rules that drive an arm."""

__all__ = ["fetch", "goal_brain", "grasp", "pick", "reach", "servo", "skills"]
