"""What happens before and after `bhd_cnn`, in LeRobot's own steps and one more."""

from dataclasses import dataclass, field
from typing import Any

from lerobot.processor import ProcessorStepRegistry
from lerobot.utils.constants import OBS_STATE
from torch import Tensor

from bhd_lerobot.policies.cnn.configuration_cnn import CnnConfig
from bhd_lerobot.policies.trained_steps import Pipelines, Stats, TrainedStep, make_pipelines

OBS_ODOMETRY = "observation.bhd_odometry"
"""Key of x [m], y [m] and yaw [rad] as they were measured, beside the normalised `observation.state`."""
OBS_RANGES = "observation.bhd_ranges"
"""Key of the ranges [m] to be learned; no input."""


@ProcessorStepRegistry.register(name="bhd_odometry_processor")
@dataclass
class OdometryProcessorStep(TrainedStep):
    """Copies odometry and ranges before the normaliser changes them."""

    odometry: list[int] = field(default_factory=list)  # columns of `observation.state`, as are the ranges
    ranges: list[int] = field(default_factory=list)

    def observation(self, observation: dict[str, Any]) -> dict[str, Any]:
        """Return the observation with odometry and ranges added."""
        state = observation.get(OBS_STATE)
        if isinstance(state, Tensor):
            observation[OBS_ODOMETRY] = state[..., self.odometry]
            observation[OBS_RANGES] = state[..., self.ranges]
        return observation


def make_bhd_cnn_pre_post_processors(config: CnnConfig, dataset_stats: Stats | None = None) -> Pipelines:
    """Return LeRobot's pipelines, with the step that keeps odometry and ranges in their units."""
    own = OdometryProcessorStep(config.odometry_columns, config.range_columns)
    return make_pipelines(config, dataset_stats, own)
