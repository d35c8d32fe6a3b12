"""MuJoCo's viewer of a simulated robot, in a process of its own."""

__all__ = ["process", "viewer"]
