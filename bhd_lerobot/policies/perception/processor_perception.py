"""What happens before and after `bhd_perception`: nothing is normalised, its image is taken as it is."""

from typing import Any

from lerobot.lerobot_types import PolicyAction
from lerobot.processor import PolicyProcessorPipeline
from torch import Tensor

from bhd_lerobot.policies.perception.configuration_perception import PerceptionConfig
from bhd_lerobot.stock import make_default_policy_processor_steps, make_policy_processor_pipelines


def make_bhd_perception_pre_post_processors(
    config: PerceptionConfig, dataset_stats: dict[str, dict[str, Tensor]] | None = None
) -> tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]], PolicyProcessorPipeline[PolicyAction, PolicyAction]
]:
    """Return LeRobot's pipelines with the mapping to nothing."""
    steps = make_default_policy_processor_steps(config, dataset_stats, normalizer_device=config.device)
    before = [steps.rename_observations, steps.add_batch_dim, steps.to_device, steps.normalize]
    return make_policy_processor_pipelines(before, [steps.unnormalize, steps.to_cpu])
