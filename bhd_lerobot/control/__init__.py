"""One tick: time, limits, modes and commands, without a physics engine, LeRobot or torch."""

__all__ = [
    "arm",
    "bridge",
    "cerebellum",
    "collision_monitor",
    "commands",
    "controller",
    "drive",
    "estop_word",
    "fifo",
    "geometry",
    "guard",
    "kernels",
    "messages",
    "motion",
    "plant",
    "reading_check",
    "record",
    "tick",
]
