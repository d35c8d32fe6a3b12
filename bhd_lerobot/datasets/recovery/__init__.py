"""Damaged and unfinished datasets."""

__all__ = ["columns", "evidence", "fix", "info", "outcomes", "repair", "rows", "salvage", "statistics", "videos"]
