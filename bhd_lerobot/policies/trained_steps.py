"""What happens before and after the trained policies, in LeRobot's own steps and a few of ours."""

from dataclasses import fields
from typing import Any, ClassVar

import torch
from lerobot.configs import PipelineFeatureType, PolicyFeature
from lerobot.lerobot_types import PolicyAction
from lerobot.processor import ObservationProcessorStep, PolicyProcessorPipeline
from lerobot.utils.constants import OBS_ENV_STATE, OBS_STATE
from torch import Tensor

from bhd_lerobot.policies.trained import TrainedConfig
from bhd_lerobot.stock import make_default_policy_processor_steps, make_policy_processor_pipelines

Stats = dict[str, dict[str, Tensor]]
type Pipelines = tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]], PolicyProcessorPipeline[PolicyAction, PolicyAction]
]


class TrainedStep(ObservationProcessorStep):
    """Base of our steps, dataclasses that change an observation or add to it."""

    is_elementwise: ClassVar[bool] = True
    """What is beside it in a batch changes nothing."""

    def get_config(self) -> dict[str, Any]:
        """Return what the step is made from again."""
        values = {one.name: getattr(self, one.name) for one in fields(self)}
        return {name: list(value) if isinstance(value, tuple | list) else value for name, value in values.items()}

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        """Return the features unchanged: what is added is not a feature of the dataset."""
        return features


def make_pipelines(config: TrainedConfig, stats: Stats | None, *own: TrainedStep, first: Any = ()) -> Pipelines:
    """Return LeRobot's pipelines, with steps of ours before normalisation, the `first` before the device."""
    least = getattr(config, "min_std", None)
    stats = stats if least is None else floored(stats, least)
    steps = make_default_policy_processor_steps(config, stats, normalizer_device=config.device)
    before = [steps.rename_observations, steps.add_batch_dim, *first, steps.to_device, *own, steps.normalize]
    return make_policy_processor_pipelines(before, [steps.unnormalize, steps.to_cpu])


def floored(stats: Stats | None, least: float) -> Stats | None:
    """Return features' statistics to divide by; those that were given are not changed.

    No standard deviation is below the least. A number of an observation that was constant, within the least deviation,
    gets an infinite one, so that it has no influence: nothing says what another value of it means.
    """
    return None if stats is None else {key: _floored(key, one, least) for key, one in stats.items()}


def _floored(key: str, stats: dict[str, Tensor], least: float) -> dict[str, Tensor]:
    found = {name: torch.as_tensor(value) for name, value in stats.items()}
    if "std" in found:
        found["std"] = found["std"].clamp(min=least)
    if key in (OBS_STATE, OBS_ENV_STATE) and {"min", "max", "std"} <= found.keys():
        constant = found["max"] - found["min"] <= 2 * least
        found["std"] = torch.where(constant, torch.inf, found["std"])
        for low, high in (("min", "max"), ("q01", "q99"), ("q10", "q90")):
            if low in found and high in found:
                found[low] = torch.where(constant, found[low] - _WIDE, found[low])
                found[high] = torch.where(constant, found[high] + _WIDE, found[high])
    return found


_WIDE = 1e9  # of what is normalised by a range: it becomes 0
