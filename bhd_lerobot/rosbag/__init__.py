"""ROS 2 bags, without ROS."""

__all__ = ["exporter", "importer", "messages", "storage"]
