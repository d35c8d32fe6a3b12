"""The controllers of an arm."""

__all__ = ["compliance", "controller", "equilibrium", "impedance", "rotations", "setpoints", "wrench"]
