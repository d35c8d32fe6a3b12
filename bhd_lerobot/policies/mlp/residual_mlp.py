"""Actions as changes: an action whose name is also observed begins where the robot is, and the network adds to that."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from lerobot.utils.constants import ACTION, OBS_STATE
from torch import Tensor, nn


class Residual(nn.Module):
    """What actions begin at, in normalised units: where the robot is.

    A network that has to give the robot's position again, a little changed, spends its precision on the position.

    Args:
        columns: of each action, the column of `observation.state` that has its name; -1 for none, which begins at 0.
        stats: mean and standard deviation of the dataset; those of a checkpoint follow with its weights.
        least: standard deviation that numbers are divided by at the least, as in the normaliser.
    """

    _scale: Tensor
    _offset: Tensor
    _columns: Tensor

    def __init__(self, columns: Sequence[int], stats: Mapping[str, Mapping[str, Any]] | None, least: float) -> None:
        super().__init__()
        found = torch.tensor(columns, dtype=torch.long)
        scale, offset = torch.zeros(len(columns)), torch.zeros(len(columns))
        if stats:
            state, action = (
                [torch.as_tensor(stats[key][name], dtype=torch.float32) for name in ("mean", "std")]
                for key in (OBS_STATE, ACTION)
            )
            known = found >= 0
            divisor = action[1].clamp(min=least)[known]
            scale[known] = state[1].clamp(min=least)[found[known]] / divisor
            offset[known] = (state[0][found[known]] - action[0][known]) / divisor
        # Not part of the checkpoint: the configuration says it.
        self.register_buffer("_columns", found.clamp(min=0), persistent=False)
        self.register_buffer("_scale", scale)
        self.register_buffer("_offset", offset)

    def forward(self, state: Tensor) -> Tensor:
        """Return what actions begin at, shape (batch, 1, actions), of normalised states, shape (batch, width)."""
        return (state[:, self._columns] * self._scale + self._offset).unsqueeze(1)


def position_columns(actions: Sequence[str], observed: Sequence[str]) -> list[int]:
    """Return of each action the column of the observation that has its name, if that is a position; else -1."""
    places = {name: place for place, name in enumerate(observed)}
    return [places.get(name, -1) if name.endswith(".pos") else -1 for name in actions]
