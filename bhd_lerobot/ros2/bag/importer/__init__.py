"""Bags into a dataset."""

__all__ = [
    "columns",
    "convert",
    "diagnostics",
    "exported",
    "options",
    "resample",
    "segments",
    "sources",
    "topics",
    "tracks",
    "video",
]
