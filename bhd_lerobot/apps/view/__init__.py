"""`bhd-data view`: a dataset in the browser."""

__all__ = ["dataset", "download", "episode", "geometry", "groups", "guard", "marking", "packing", "server"]
