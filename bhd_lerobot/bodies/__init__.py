"""Numbers about hardware, each with its source; arenas, and what can lie on a table."""

__all__ = [
    "arenas",
    "body",
    "differential_base",
    "registry",
    "scenes",
    "tabletop",
    "truth",
    "turtlebot3",
    "ur5",
]
