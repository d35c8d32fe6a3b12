"""Episodes into a dataset: `bhd-record`, and what others command."""

__all__ = [
    "config",
    "driver",
    "live_view",
    "onlooker",
    "passive",
    "record",
    "report",
    "reset",
    "status",
    "takes",
]
