"""What happens before and after `bhd_mlp`, in LeRobot's own steps."""

from typing import Any

import torch
from lerobot.lerobot_types import PolicyAction
from lerobot.processor import PolicyProcessorPipeline
from torch import Tensor

from bhd_lerobot.errors import ConfigError
from bhd_lerobot.policies.mlp.configuration_mlp import MlpConfig
from bhd_lerobot.policies.mlp.objects_mlp import ObjectOrderProcessorStep
from bhd_lerobot.policies.mlp.scan_mlp import ScanProcessorStep
from bhd_lerobot.policies.mlp.yaw_mlp import YawProcessorStep
from bhd_lerobot.stock import make_default_policy_processor_steps, make_policy_processor_pipelines

type Pipelines = tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]], PolicyProcessorPipeline[PolicyAction, PolicyAction]
]


def make_bhd_mlp_pre_post_processors(
    config: MlpConfig, dataset_stats: dict[str, dict[str, Tensor]] | None = None
) -> tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]], PolicyProcessorPipeline[PolicyAction, PolicyAction]
]:
    """Return the pipelines that normalise observations and give actions their units back."""
    stats = floored(dataset_stats, config.min_std)
    steps = make_default_policy_processor_steps(config, stats, normalizer_device=config.device)
    before = [steps.rename_observations, steps.add_batch_dim, steps.to_device]
    if config.scan.is_used and config.scan.transform != "none":
        if config.scan.start is None:
            raise ConfigError("policy.scan.start is not known yet; make the policy before its processors.")
        before.append(ScanProcessorStep(start=config.scan.start, beams=config.scan.beams))
    if config.sort_objects:
        if not config.objects:
            raise ConfigError("The objects' columns are not known yet; make the policy before its processors.")
        start, count, size, *fields = config.objects
        before.append(ObjectOrderProcessorStep(start, count, size, tuple(fields), tuple(config.tool_columns)))
    if config.yaw_harmonics:
        if not config.quaternions:
            raise ConfigError("The quaternions' columns are not known yet; make the policy before its processors.")
        before.append(YawProcessorStep(config.state_quaternions, config.environment_quaternions))
    return make_policy_processor_pipelines([*before, steps.normalize], [steps.unnormalize, steps.to_cpu])


def floored(stats: dict[str, dict[str, Tensor]] | None, least: float) -> dict[str, dict[str, Tensor]] | None:
    """Return features' statistics with no standard deviation below the least; those that were given are not changed."""
    if stats is None:
        return None
    return {
        key: {name: torch.as_tensor(value).clamp(min=least) if name == "std" else value for name, value in one.items()}
        for key, one in stats.items()
    }
