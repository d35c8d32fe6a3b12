"""The controllers of a base on wheels."""

__all__ = ["controller", "diff_drive", "limits"]
