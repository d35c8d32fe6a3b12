"""Bags into a dataset."""

__all__ = [
    "columns",
    "convert",
    "diagnostics",
    "frames",
    "options",
    "resample",
    "segments",
    "sources",
    "topics",
    "tracks",
    "video",
]
