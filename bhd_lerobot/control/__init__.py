"""One tick: time, limits, modes and commands, without a physics engine, LeRobot or torch."""

__all__ = [
    "arm",
    "base",
    "bridge",
    "cerebellum",
    "commands",
    "controller",
    "estop",
    "estop_terminal",
    "fifo",
    "geometry",
    "messages",
    "motion",
    "plant",
    "timing",
    "tolerance",
]
