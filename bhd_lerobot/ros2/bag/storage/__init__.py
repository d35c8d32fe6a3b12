"""Files of bags, MCAP and SQLite."""

__all__ = ["find", "mcap", "place", "read", "sqlite", "unpack", "write"]
