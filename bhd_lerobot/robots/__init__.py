"""LeRobot's view of the hand, and a check of its contract."""

__all__ = [
    "arm",
    "arm_host",
    "arm_simulation",
    "base",
    "base_host",
    "base_simulation",
    "config",
    "config_arm",
    "config_turtlebot3",
    "config_ur5",
    "conformance",
    "device",
    "external",
    "host",
    "latency",
    "robot",
    "turtlebot3",
    "ur5",
    "viewer",
]
