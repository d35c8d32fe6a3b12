"""The tasks as Gymnasium and LeRobot see them."""

__all__ = [
    "config_env",
    "episodes",
    "gym_env",
    "register",
    "sequence",
    "settings",
    "spaces",
    "stable_baselines",
    "vector",
    "vector_member",
]
