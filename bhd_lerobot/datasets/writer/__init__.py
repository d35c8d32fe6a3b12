"""The recorder, which a kill costs at most the running episode."""

__all__ = ["commit", "encoder_process", "episode", "recorder"]
