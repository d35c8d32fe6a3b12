"""Files of bags, MCAP and SQLite."""

__all__ = ["crash_safe", "find", "mcap", "place", "read", "sqlite", "unpack", "write"]
