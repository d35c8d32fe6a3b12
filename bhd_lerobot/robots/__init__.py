"""LeRobot's view of the hand, and a check of its contract."""

__all__ = [
    "arm",
    "base",
    "config",
    "config_arm",
    "config_mobile_arm",
    "config_turtlebot3",
    "config_ur",
    "conformance",
    "device",
    "external",
    "host",
    "mobile_arm",
    "parts",
    "robot",
    "turtlebot3",
    "ur",
    "viewer",
]
