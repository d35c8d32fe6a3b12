"""The command lines; nothing imports them."""

__all__ = ["data", "doctor", "evaluate", "monitor", "record", "replay", "start", "train"]
