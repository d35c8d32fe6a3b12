"""Orientations on their way into the network: as sines and cosines of multiples of the yaw, past the normalisation."""

from dataclasses import dataclass, field
from typing import Any

import torch
from lerobot.processor import ProcessorStepRegistry
from lerobot.utils.constants import OBS_ENV_STATE, OBS_STATE
from torch import Tensor

from bhd_lerobot.policies.trained_steps import TrainedStep

OBS_YAW = "observation.bhd_yaw"
"""Key of the yaws [rad] of all quaternions, beside the normalised inputs that they were computed from."""


@ProcessorStepRegistry.register(name="bhd_yaw_processor")
@dataclass
class YawProcessorStep(TrainedStep):
    """Computes the yaws of quaternions before the normaliser changes them.

    Attributes:
        state: columns of `observation.state` at which a quaternion wxyz begins.
        environment: likewise of `observation.environment_state`.
    """

    state: list[int] = field(default_factory=list)
    environment: list[int] = field(default_factory=list)

    def observation(self, observation: dict[str, Any]) -> dict[str, Any]:
        """Return the observation with the yaws added: those in the state, then those in the environment state."""
        parts = []
        for key, columns in ((OBS_STATE, self.state), (OBS_ENV_STATE, self.environment)):
            values = observation.get(key)
            if isinstance(values, Tensor):
                parts += [yaw(values[..., first : first + 4]) for first in columns]
        # If an input is missing, the policy says so.
        if parts and len(parts) == len(self.state) + len(self.environment):
            observation[OBS_YAW] = torch.stack(parts, dim=-1)
        return observation


def yaw(quaternions: Tensor) -> Tensor:
    """Return the rotation about the vertical axis [rad], shape (...), of quaternions wxyz, shape (..., 4).

    That of the rotated x axis, seen from above; 0 where it is vertical. The quaternions need not be of unit length.
    """
    w, x, y, z = quaternions.unbind(-1)
    return torch.atan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z)


def harmonics(yaws: Tensor, count: int) -> Tensor:
    """Return cosines and sines of 1 to `count` times the yaws, shape (..., 2 * count * m), of yaws, shape (..., m)."""
    multiples = torch.arange(1, count + 1, dtype=yaws.dtype, device=yaws.device)
    angles = (yaws.unsqueeze(-1) * multiples).flatten(-2)
    return torch.cat([angles.cos(), angles.sin()], dim=-1)
