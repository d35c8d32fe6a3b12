"""Brains: rules, planners and checkpoints."""

__all__ = [
    "baselines",
    "blanked",
    "brain",
    "cnn",
    "dagger",
    "language",
    "learned",
    "manipulation",
    "mlp",
    "navigation",
    "perception",
    "pixels",
    "start_pose",
    "teleop",
    "topic",
    "trained",
    "trained_steps",
]
