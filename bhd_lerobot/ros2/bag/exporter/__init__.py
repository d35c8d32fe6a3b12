"""Episodes into bags."""

__all__ = ["episode", "export"]
