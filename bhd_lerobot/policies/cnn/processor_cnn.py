"""What happens before and after `bhd_cnn`, in LeRobot's own steps and one more."""

from dataclasses import dataclass, field
from typing import Any, ClassVar

from lerobot.configs import PipelineFeatureType, PolicyFeature
from lerobot.lerobot_types import PolicyAction
from lerobot.processor import ObservationProcessorStep, PolicyProcessorPipeline, ProcessorStepRegistry
from lerobot.utils.constants import OBS_STATE
from torch import Tensor

from bhd_lerobot.policies.cnn.configuration_cnn import CnnConfig
from bhd_lerobot.policies.mlp.processor_mlp import floored
from bhd_lerobot.stock import make_default_policy_processor_steps, make_policy_processor_pipelines

OBS_ODOMETRY = "observation.bhd_odometry"
"""Key of x [m], y [m] and yaw [rad] as they were measured, beside the normalised `observation.state`."""
OBS_RANGES = "observation.bhd_ranges"
"""Key of the ranges [m] that are to be learned; no input."""


@ProcessorStepRegistry.register(name="bhd_odometry_processor")
@dataclass
class OdometryProcessorStep(ObservationProcessorStep):
    """Copies odometry and ranges before the normaliser changes them.

    Attributes:
        odometry: columns of `observation.state`.
        ranges: likewise.
    """

    is_elementwise: ClassVar[bool] = True
    """What is beside it in a batch changes nothing."""

    odometry: list[int] = field(default_factory=list)
    ranges: list[int] = field(default_factory=list)

    def observation(self, observation: dict[str, Any]) -> dict[str, Any]:
        """Return the observation with odometry and ranges added."""
        state = observation.get(OBS_STATE)
        if isinstance(state, Tensor):
            observation[OBS_ODOMETRY] = state[..., self.odometry]
            observation[OBS_RANGES] = state[..., self.ranges]
        return observation

    def get_config(self) -> dict[str, Any]:
        """Return what the step is made from again."""
        return {"odometry": list(self.odometry), "ranges": list(self.ranges)}

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        """Return the features unchanged: what is added is not a feature of the dataset."""
        return features


def make_bhd_cnn_pre_post_processors(
    config: CnnConfig, dataset_stats: dict[str, dict[str, Tensor]] | None = None
) -> tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]], PolicyProcessorPipeline[PolicyAction, PolicyAction]
]:
    """Return LeRobot's pipelines, with the step that keeps odometry and ranges in their units."""
    stats = floored(dataset_stats, config.min_std)
    steps = make_default_policy_processor_steps(config, stats, normalizer_device=config.device)
    own = OdometryProcessorStep(config.odometry_columns, config.range_columns)
    before = [steps.rename_observations, steps.add_batch_dim, steps.to_device, own, steps.normalize]
    return make_policy_processor_pipelines(before, [steps.unnormalize, steps.to_cpu])
