"""The command lines; nothing imports them."""

__all__ = ["data", "demo", "doctor", "evaluate", "monitor", "record", "replay", "ros2", "serve", "start", "train"]
