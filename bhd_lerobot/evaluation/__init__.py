"""`bhd-eval`: brains on the same episodes, with intervals and a report."""

__all__ = [
    "config",
    "environment",
    "evaluate",
    "metrics",
    "operator",
    "perception",
    "plan",
    "plots",
    "report",
    "results",
    "run",
    "sequential",
    "statistics",
    "text",
]
