"""The controllers of an arm."""

__all__ = [
    "clearance",
    "compliance",
    "controller",
    "equilibrium",
    "force_limit",
    "held",
    "impedance",
    "relief",
    "setpoints",
    "spring",
    "step",
    "wrench",
]
