"""Paths, locks and changes that are complete or not there."""

__all__ = ["atomic", "disk", "layout", "places", "pointers"]
