"""A brain in another process, on a ROS 2 network."""

__all__ = ["brain", "config"]
