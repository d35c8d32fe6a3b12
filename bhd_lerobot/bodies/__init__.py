"""Numbers about hardware, each with its source; arenas, and what can lie on a table."""

__all__ = [
    "arenas",
    "arm_file",
    "body",
    "differential_base",
    "fetch_scene",
    "registry",
    "scenes",
    "so101",
    "tabletop",
    "truth",
    "turtlebot3",
    "turtlebot3_manipulation",
    "ur",
]
