"""Actions as changes: an action that is also observed begins where the robot is, and the network adds to that."""

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
        stats: mean and standard deviation of the dataset; those of a checkpoint come with its weights.
        least: standard deviation that numbers are divided by at the least, as in the normaliser.
    """

    _scale: Tensor
    _offset: Tensor
    _columns: Tensor
    _is_known: Tensor

    def __init__(self, columns: Sequence[int], stats: Mapping[str, Mapping[str, Any]] | None, least: float) -> None:
        super().__init__()
        found = torch.tensor(columns, dtype=torch.long)
        self._least = least
        # Not part of the checkpoint: the configuration says it.
        self.register_buffer("_is_known", found >= 0, persistent=False)
        self.register_buffer("_columns", found.clamp(min=0), persistent=False)
        self.register_buffer("_scale", torch.zeros(len(columns)))
        self.register_buffer("_offset", torch.zeros(len(columns)))
        if stats:
            self.use_statistics(stats)

    def use_statistics(self, stats: Mapping[str, Mapping[str, Any]]) -> None:
        """Take other statistics, which states and actions are normalised by from now on."""
        (state_mean, state_std), (mean, std) = (
            [torch.as_tensor(stats[key][name], dtype=torch.float32).to(self._scale) for name in ("mean", "std")]
            for key in (OBS_STATE, ACTION)
        )
        known = self._is_known
        columns, divisor = self._columns[known], std.clamp(min=self._least)[known]
        state_std = torch.where(state_std.isinf(), 0.0, state_std.clamp(min=self._least))  # constant: it is the mean
        self._scale[known] = state_std[columns] / divisor
        self._offset[known] = (state_mean[columns] - mean[known]) / divisor

    def forward(self, state: Tensor) -> Tensor:
        """Return what actions begin at, shape (batch, 1, actions), of normalised states, shape (batch, width)."""
        return (state[:, self._columns] * self._scale + self._offset).unsqueeze(1)
