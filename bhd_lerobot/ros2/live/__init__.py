"""Robots on a ROS 2 network, through Cyclone DDS, without a ROS installation."""

__all__ = [
    "channel",
    "clients",
    "clock_offset",
    "graph",
    "link",
    "network",
    "node",
    "process",
    "spec",
    "topic_types",
    "topics",
    "type_description",
]
