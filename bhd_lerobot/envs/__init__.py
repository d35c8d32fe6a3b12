"""The tasks as Gymnasium and LeRobot see them."""

__all__ = [
    "config_env",
    "course",
    "gym_env",
    "register",
    "settings",
    "spaces",
    "stable_baselines",
    "stage",
    "vector",
    "vector_member",
]
