"""Objects on their way into the network: in an order of their own, and where what is meant is from the tool."""

from dataclasses import dataclass
from typing import Any

import torch
from lerobot.processor import ProcessorStepRegistry
from lerobot.utils.constants import OBS_ENV_STATE, OBS_STATE
from torch import Tensor

from bhd_lerobot.policies.mlp.yaw_mlp import harmonics, yaw
from bhd_lerobot.policies.trained_steps import TrainedStep

FIELDS = ("present", "target", "x", "y", "z", "qw", "qx", "qy", "qz")
"""What has to be told of every object, as `object_0_present` and so on."""

OBS_RELATIVE = "observation.bhd_relative"
"""Key of where what is meant is from the tool: x, y, z in the base frame [m], and its yaw from the tool's [rad]."""

SCALES = (0.1, 0.02, 0.005)
"""Distances from the tool are told apart within these [m]."""


@ProcessorStepRegistry.register(name="bhd_object_order_processor")
@dataclass
class ObjectOrderProcessorStep(TrainedStep):
    """Sorts the objects in `observation.environment_state`: what is meant first, then the nearest to it.

    A network then finds each object in the same inputs and need not learn to look for it; what stands in which row of
    the observation tells nothing. Where the tool is observed, `OBS_RELATIVE` is added.

    Attributes:
        start: column at which the first object begins.
        count: objects that there may be.
        size: numbers of each.
        fields: where `FIELDS` are among the numbers of an object.
        tool: columns of `observation.state` that have `TOOL`; nothing if it is not observed.
    """

    start: int = 0
    count: int = 0
    size: int = 0
    fields: tuple[int, ...] = ()
    tool: tuple[int, ...] = ()

    def observation(self, observation: dict[str, Any]) -> dict[str, Any]:
        """Return the observation with its objects sorted."""
        values = observation.get(OBS_ENV_STATE)
        if isinstance(values, Tensor):
            end = self.start + self.count * self.size
            rows = values[..., self.start : end].unflatten(-1, (self.count, self.size))
            ordered = in_order(rows, self.fields).flatten(-2)
            observation[OBS_ENV_STATE] = torch.cat([values[..., : self.start], ordered, values[..., end:]], dim=-1)
            state = observation.get(OBS_STATE)
            if self.tool and isinstance(state, Tensor):
                meant = ordered[..., : self.size][..., list(self.fields[2:])]
                observation[OBS_RELATIVE] = _relative(state[..., list(self.tool)], meant)
        return observation


def in_order(rows: Tensor, fields: tuple[int, ...] | list[int]) -> Tensor:
    """Return objects, shape (…, count, size): what is meant first, then the nearest to it, what is not there last."""
    present, target, x, y, *_ = fields
    is_meant = (rows[..., target] > 0.5) & (rows[..., present] > 0.5)
    place = rows[..., [x, y]]
    meant = (place * is_meant.unsqueeze(-1)).sum(-2, keepdim=True)
    apart = (place - meant).square().sum(-1)
    apart = apart.masked_fill(is_meant, -1.0).masked_fill(rows[..., present] <= 0.5, torch.inf)
    order = apart.argsort(dim=-1, stable=True).unsqueeze(-1).expand_as(rows)
    return rows.gather(-2, order)


def _relative(tool: Tensor, item: Tensor) -> Tensor:
    """Return where objects are from tools, shape (…, 4), of poses, shape (…, 7)."""
    turned = yaw(item[..., 3:]) - yaw(tool[..., 3:])
    return torch.cat([item[..., :3] - tool[..., :3], turned.unsqueeze(-1)], dim=-1)


def relative_size(count: int) -> int:
    """Return how many numbers `relative_features` makes, with `count` harmonics."""
    return 3 * len(SCALES) + 2 * count


def relative_features(values: Tensor, count: int) -> Tensor:
    """Return what a network sees of `OBS_RELATIVE`, shape (…, `relative_size`).

    Metres and millimetres at once: each coordinate at several scales, beyond which it counts as far away; and
    harmonics of the yaw.

    Args:
        values: shape (…, 4).
        count: harmonics of the yaw.
    """
    places = [torch.tanh(values[..., :3] / scale) for scale in SCALES]
    return torch.cat([*places, harmonics(values[..., 3:], count)], dim=-1)


def object_columns(names: list[str]) -> tuple[int, int, int, tuple[int, ...]]:
    """Return start, count, size and fields of the objects among the names of an environment state; zeros without any.

    Args:
        names: of all columns; those of objects are `object_K_FIELD`, K from 0, each with the same fields in a row.
    """
    own = [name for name in names if name.startswith("object_")]
    first = [name.removeprefix("object_0_") for name in own if name.startswith("object_0_")]
    if not first or len(own) % len(first) or not set(FIELDS) <= set(first):
        return 0, 0, 0, ()
    count, start = len(own) // len(first), names.index(own[0])
    wanted = [f"object_{number}_{field}" for number in range(count) for field in first]
    if names[start : start + len(wanted)] != wanted:
        return 0, 0, 0, ()
    return start, count, len(first), tuple(first.index(field) for field in FIELDS)
