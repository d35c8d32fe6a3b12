"""`bhd-record`: episodes into a dataset."""

__all__ = ["config", "live_view", "record", "report", "resume_advice"]
