"""Batches for training, from memory."""

__all__ = [
    "batches",
    "check",
    "config",
    "frame_cache",
    "gather",
    "loader",
    "metadata",
    "order",
    "selection",
    "source",
    "table",
    "table_dataset",
]
