"""Robots on a ROS 2 network, through Cyclone DDS, without a ROS installation."""

__all__ = ["clients", "graph", "network", "node", "topic_types"]
