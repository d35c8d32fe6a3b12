"""Checkpoints as brains, and what they were trained on."""

__all__ = ["brain", "checkpoint", "checkpoint_guard", "contract", "inference", "policy"]
