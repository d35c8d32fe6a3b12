"""LeRobotDatasets: recorded, loaded, checked, repaired, edited and moved."""

__all__ = ["assembly", "edit", "format", "loader", "recovery", "remote", "storage", "timing", "validate", "writer"]
