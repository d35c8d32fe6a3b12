"""Whether a dataset is valid."""

__all__ = ["dataset", "files", "findings", "frozen", "statistics", "steps", "values"]
