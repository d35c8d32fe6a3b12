"""Bags into a dataset."""

__all__ = [
    "columns",
    "convert",
    "diagnostics",
    "options",
    "resample",
    "segments",
    "sources",
    "topics",
    "tracks",
    "video",
]
