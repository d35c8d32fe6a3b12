"""Kinematics, collisions, dynamics and poses."""

__all__ = ["chain", "collision", "dynamics", "forward_kinematics", "inverse_kinematics", "kinematics", "poses"]
