"""Datasets that are made of others."""

__all__ = ["assemble", "compact", "creation", "files", "picks"]
