"""ROS 2 without a ROS installation."""

__all__ = ["bag", "live", "messages", "robots", "serve"]
