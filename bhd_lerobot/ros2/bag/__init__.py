"""ROS 2 bags: files, datasets as bags, bags as datasets, bags of a network and on a network."""

__all__ = ["exporter", "importer", "player", "recorder", "storage"]
