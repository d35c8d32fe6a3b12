"""Brains: rules, planners and checkpoints."""

__all__ = [
    "baselines",
    "blanked",
    "brain",
    "dagger",
    "language",
    "learned",
    "manipulation",
    "mlp",
    "navigation",
    "perception",
    "pixels",
]
