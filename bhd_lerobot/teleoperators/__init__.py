"""Teleoperators for LeRobot: a brain in place of a person, and people at the keys of a terminal."""

__all__ = [
    "bhd_brain",
    "bhd_keyboard_arm",
    "bhd_keyboard_base",
    "config_bhd_brain",
    "config_bhd_keyboard_arm",
    "config_bhd_keyboard_base",
    "config_keyboard",
    "keyboard",
    "plain",
    "targets",
]
