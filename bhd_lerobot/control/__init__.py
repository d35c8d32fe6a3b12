"""One tick: time, limits, modes and commands, without a physics engine, LeRobot or torch."""

__all__ = [
    "arm",
    "base",
    "bridge",
    "cerebellum",
    "commands",
    "controller",
    "estop",
    "estop_word",
    "fifo",
    "geometry",
    "guard",
    "kernels",
    "keys",
    "messages",
    "motion",
    "plant",
    "reading_check",
    "timing",
    "tolerance",
]
