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
        quaternions: of the actions, the columns at which quaternions begin.
    """

    _scale: Tensor
    _offset: Tensor
    _columns: Tensor
    _is_known: Tensor
    _mean: Tensor
    _divisor: Tensor

    def __init__(
        self,
        columns: Sequence[int],
        stats: Mapping[str, Mapping[str, Any]] | None,
        least: float,
        quaternions: Sequence[int] = (),
    ) -> None:
        super().__init__()
        self._quaternions = [slice(first, first + 4) for first in quaternions]
        found = torch.tensor(columns, dtype=torch.long)
        self._least = least
        # Not part of the checkpoint: the configuration says it.
        self.register_buffer("_is_known", found >= 0, persistent=False)
        self.register_buffer("_columns", found.clamp(min=0), persistent=False)
        self.register_buffer("_scale", torch.zeros(len(columns)))
        self.register_buffer("_offset", torch.zeros(len(columns)))
        for name in ("_mean", "_divisor"):  # of the actions that are learned
            self.register_buffer(name, torch.zeros(len(columns)), persistent=False)
        if stats:
            self.use_statistics(stats)

    def use_statistics(self, stats: Mapping[str, Mapping[str, Any]]) -> None:
        """Take other statistics, which states and actions are normalised by from now on."""
        (state_mean, state_std), (mean, std) = (
            [torch.as_tensor(stats[key][name], dtype=torch.float32).to(self._scale) for name in ("mean", "std")]
            for key in (OBS_STATE, ACTION)
        )
        known = self._is_known
        self._mean.copy_(mean)
        self._divisor.copy_(std.clamp(min=self._least))
        columns, divisor = self._columns[known], self._divisor[known]
        state_std = torch.where(state_std.isinf(), 0.0, state_std.clamp(min=self._least))  # constant: it is the mean
        self._scale[known] = state_std[columns] / divisor
        self._offset[known] = (state_mean[columns] - mean[known]) / divisor

    def forward(self, state: Tensor) -> Tensor:
        """Return what actions begin at, shape (batch, 1, actions), of normalised states, shape (batch, width)."""
        return (state[:, self._columns] * self._scale + self._offset).unsqueeze(1)

    def nearer(self, actions: Tensor, state: Tensor) -> Tensor:
        """Return actions with every quaternion of the sign that is nearer to what they begin at.

        A quaternion and its negative are one orientation. Where a recording goes from one to the other, what is to be
        added would be a jump across the sphere.

        Args:
            actions: to be learned, normalised, shape (batch, chunk, actions).
            state: normalised, shape (batch, width).
        """
        if not self._quaternions:
            return actions
        values = actions * self._divisor + self._mean
        near = self(state) * self._divisor + self._mean
        turned = (-values - self._mean) / self._divisor.clamp_min(self._least)
        parts = list(actions.split(1, dim=-1))
        for one in self._quaternions:
            is_other = (values[..., one] * near[..., one]).sum(-1, keepdim=True) < 0
            parts[one] = torch.where(is_other, turned[..., one], actions[..., one]).split(1, dim=-1)
        return torch.cat(parts, dim=-1)
