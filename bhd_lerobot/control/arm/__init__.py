"""The controllers of an arm."""

__all__ = [
    "clearance",
    "compliance",
    "controller",
    "equilibrium",
    "force_limit",
    "held",
    "impedance",
    "mobile",
    "relief",
    "setpoints",
    "spring",
    "step",
    "wrench",
]
