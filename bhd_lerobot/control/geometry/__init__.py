"""Kinematics, collisions, dynamics and poses."""

__all__ = ["collision", "dynamics", "forward_kinematics", "inverse_kinematics", "kinematics", "poses"]
