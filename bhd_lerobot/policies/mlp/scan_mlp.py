"""Beams on their way into the network: past the normalisation, and through circular convolutions."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from lerobot.processor import ProcessorStepRegistry
from lerobot.utils.constants import OBS_STATE
from torch import Tensor, nn

from bhd_lerobot.policies.mlp.configuration_mlp import ScanConfig
from bhd_lerobot.policies.trained_steps import TrainedStep

OBS_SCAN = "observation.bhd_scan"
"""Key of the ranges [m], as they were measured, beside the normalised `observation.state`."""


@ProcessorStepRegistry.register(name="bhd_scan_processor")
@dataclass
class ScanProcessorStep(TrainedStep):
    """Copies the ranges to `OBS_SCAN` before the normaliser changes them."""

    start: int = 0  # column of the first beam in `observation.state`
    beams: int = 0

    def observation(self, observation: dict[str, Any]) -> dict[str, Any]:
        """Return the observation with the ranges in metres added."""
        state = observation.get(OBS_STATE)
        if isinstance(state, Tensor):
            observation[OBS_SCAN] = state[..., self.start : self.start + self.beams]
        return observation


def transformed(ranges: Tensor, config: ScanConfig) -> Tensor:
    """Return ranges [m] as network inputs, of the same shape."""
    near = ranges.clamp(min=config.minimum)
    return config.scale / near if config.transform == "inverse" else torch.log(near / config.scale)


class ScanEncoder(nn.Module):
    """Convolutions over a closed circle of beams: turning the robot turns what they see."""

    def __init__(self, config: ScanConfig, n_obs_steps: int, activation: type[nn.Module]) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        width, beams = n_obs_steps, config.beams
        for channels in config.channels:
            padding = config.kernel_size // 2
            layers.append(
                nn.Conv1d(width, channels, config.kernel_size, config.stride, padding, padding_mode="circular")
            )
            layers.append(activation())
            width, beams = channels, (beams - 1) // config.stride + 1
        self.layers = nn.Sequential(*layers, nn.Flatten())
        self.size = width * beams

    def forward(self, scans: Tensor) -> Tensor:
        """Return features, shape (batch, size), of scans, shape (batch, n_obs_steps, beams)."""
        return self.layers(scans)


def other_columns(width: int, start: int, beams: int, ignored: Sequence[int] = ()) -> Sequence[int]:
    """Return the columns of a state that are neither beams nor ignored."""
    skipped = {*range(start, start + beams), *ignored}
    return [column for column in range(width) if column not in skipped]
