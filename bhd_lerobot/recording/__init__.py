"""`bhd-record`: episodes into a dataset."""

__all__ = [
    "config",
    "driver",
    "live_view",
    "record",
    "report",
    "reset",
    "resume_advice",
    "status",
    "takes",
]
