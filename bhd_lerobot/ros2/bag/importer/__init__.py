"""Bags into a dataset."""

__all__ = [
    "columns",
    "convert",
    "diagnostics",
    "exported",
    "frames",
    "options",
    "resample",
    "segments",
    "sources",
    "topics",
    "tracks",
    "video",
]
