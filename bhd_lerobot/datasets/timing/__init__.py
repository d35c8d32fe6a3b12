"""How punctual the frames of a dataset are."""

__all__ = ["plots", "report", "tables"]
