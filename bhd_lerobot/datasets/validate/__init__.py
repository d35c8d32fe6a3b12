"""Whether a dataset is valid."""

__all__ = ["dataset", "files", "findings", "frozen", "order", "statistics", "steps", "values"]
