"""The command lines; nothing imports them."""

__all__ = ["data", "demo", "doctor", "evaluate", "monitor", "record", "replay", "serve", "start", "train"]
