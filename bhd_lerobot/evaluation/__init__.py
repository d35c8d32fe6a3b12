"""`bhd-eval`: brains on the same episodes, with intervals and a report."""

__all__ = [
    "config",
    "environment",
    "evaluate",
    "metrics",
    "perception",
    "plots",
    "report",
    "results",
    "run",
    "statistics",
    "text",
]
