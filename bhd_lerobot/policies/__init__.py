"""Brains: rules, planners and checkpoints."""

__all__ = ["baselines", "brain", "dagger", "language", "learned", "manipulation", "mlp", "navigation"]
