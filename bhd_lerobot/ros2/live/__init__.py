"""Robots on a ROS 2 network, through Cyclone DDS, without a ROS installation."""

<<<<<<< HEAD
__all__ = ["clients", "graph", "network", "node", "topic_types"]
=======
__all__ = [
    "arm_plant",
    "base_plant",
    "channel",
    "clock_offset",
    "graph",
    "link",
    "network",
    "node",
    "plant",
    "process",
    "spec",
    "topic_types",
]
>>>>>>> main
