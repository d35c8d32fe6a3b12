"""Episodes on many machines."""

__all__ = ["cluster", "config", "job", "loop", "pool", "remote"]
