"""A target pose on its way into the network: where it is from the tool."""

from dataclasses import dataclass
from typing import Any

import torch
from lerobot.processor import ProcessorStepRegistry
from lerobot.utils.constants import OBS_ENV_STATE, OBS_STATE
from torch import Tensor

from bhd_lerobot.policies.mlp.objects_mlp import SCALES
from bhd_lerobot.policies.trained_steps import TrainedStep

OBS_TARGET = "observation.bhd_target"
"""Key of where the target is from the tool, in the base frame: x, y, z [m], and a rotation vector [rad]."""

TARGET_SIZE = 18
"""How many numbers `target_features` makes."""

_TURNS = (1.0, 0.2, 0.05)  # [rad] within which turns are told apart


@ProcessorStepRegistry.register(name="bhd_target_processor")
@dataclass
class TargetProcessorStep(TrainedStep):
    """Adds `OBS_TARGET`, before the normaliser changes what it is computed from.

    A network learns a difference of two of its inputs badly where it has to be small, and of two quaternions not at
    all: one and its negative are the same orientation.

    Attributes:
        tool: columns of `observation.state` that have `TOOL`.
        target: columns of `observation.environment_state` that have `TARGET`.
    """

    tool: tuple[int, ...] = ()
    target: tuple[int, ...] = ()

    def observation(self, observation: dict[str, Any]) -> dict[str, Any]:
        """Return the observation with where the target is added."""
        state, told = observation.get(OBS_STATE), observation.get(OBS_ENV_STATE)
        if isinstance(state, Tensor) and isinstance(told, Tensor):
            tool, target = state[..., list(self.tool)], told[..., list(self.target)]
            turn = rotation_vector(tool[..., 3:], target[..., 3:])
            observation[OBS_TARGET] = torch.cat([target[..., :3] - tool[..., :3], turn], dim=-1)
        return observation


def rotation_vector(first: Tensor, second: Tensor) -> Tensor:
    """Return the turn from one orientation to another in their common frame, by at most half a turn [rad].

    Args:
        first: quaternions wxyz, shape (..., 4); they need not be of unit length.
        second: likewise.

    Returns:
        Axis times angle, shape (..., 3).
    """
    (a, b), (v, u) = (first[..., :1], second[..., :1]), (first[..., 1:], second[..., 1:])
    w = a * b + (v * u).sum(-1, keepdim=True)
    axis = a * u - b * v - torch.linalg.cross(u, v)
    axis = torch.where(w < 0, -axis, axis)
    sine = axis.norm(dim=-1, keepdim=True)
    angle = 2 * torch.atan2(sine, w.abs())
    return axis * (angle / sine.clamp_min(torch.finfo(sine.dtype).tiny))


def target_features(values: Tensor) -> Tensor:
    """Return what a network sees of `OBS_TARGET`, shape (…, `TARGET_SIZE`): each number at several scales.

    Beyond a scale it counts as far away.

    Args:
        values: shape (…, 6).
    """
    places = [torch.tanh(values[..., :3] / scale) for scale in SCALES]
    turns = [torch.tanh(values[..., 3:] / scale) for scale in _TURNS]
    return torch.cat([*places, *turns], dim=-1)
