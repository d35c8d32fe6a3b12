"""Kinematics, collisions, dynamics and poses."""

__all__ = [
    "capsules",
    "chain",
    "collision",
    "dynamics",
    "forward_kinematics",
    "inverse_kinematics",
    "kinematics",
    "numeric_inverse",
    "poses",
    "rigid_bodies",
    "rotations",
]
