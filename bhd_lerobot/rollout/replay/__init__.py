"""Replay of recorded episodes, in simulation and on a robot."""

__all__ = [
    "config",
    "on_robot",
    "simulated",
]
