"""The controllers of a base on wheels."""

__all__ = ["collision_monitor", "controller", "drive"]
