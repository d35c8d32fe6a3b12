"""`bhd_mlp`, a small policy that needs no GPU."""

__all__ = [
    "configuration_mlp",
    "modeling_mlp",
    "objects_mlp",
    "processor_mlp",
    "residual_mlp",
    "scan_mlp",
    "statistics_mlp",
    "target_mlp",
    "yaw_mlp",
]
