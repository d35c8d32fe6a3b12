"""Rules that drive a base."""

__all__ = ["avoidance", "clearance", "driving", "gap_follower", "goal_map", "navigator", "scan", "steering"]
