"""ROS 2 bags: files, datasets as bags, bags as datasets."""

__all__ = ["exporter", "importer", "storage"]
