"""Delete, keep, split, merge and mark."""

__all__ = ["edits", "mark", "overlap"]
