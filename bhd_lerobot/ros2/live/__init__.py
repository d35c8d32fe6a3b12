"""Robots on a ROS 2 network, through Cyclone DDS, without a ROS installation."""

__all__ = ["graph", "network", "node", "topic_types"]
