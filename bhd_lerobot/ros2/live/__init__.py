"""Robots on a ROS 2 network, through Cyclone DDS, without a ROS installation."""

__all__ = [
    "arm_plant",
    "base_plant",
    "channel",
    "clients",
    "clock_offset",
    "config_robot",
    "graph",
    "link",
    "network",
    "node",
    "plant",
    "process",
    "robot",
    "spec",
    "topic_types",
    "topics",
]
