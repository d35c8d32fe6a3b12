"""Statistics of the dataset that are part of a policy's weights, and have to be those that its normaliser has."""

from collections.abc import Mapping
from typing import Any, Self

import torch

from bhd_lerobot.errors import ConfigError

type Statistics = Mapping[str, Mapping[str, Any]]
"""Mean and standard deviation, among others, of each feature."""


class KeepsStatistics:
    """Of a policy, before LeRobot's own class: it keeps statistics of its dataset in buffers.

    Loaded for a training on a dataset with other statistics it refuses to learn until it is told which count:
    `lerobot-train` normalises by the dataset's where it fine-tunes, and by the checkpoint's where it goes on, and does
    not say which it does.
    """

    name: str
    _is_unlike = False

    @classmethod
    def from_pretrained(cls, *args: Any, **kwargs: Any) -> Self:
        """Return the policy of a checkpoint; arguments are LeRobot's, `dataset_stats` are given for a training only."""
        parent: Any = super()
        policy = parent.from_pretrained(*args, **kwargs)
        if kwargs.get("dataset_stats"):
            kept = {name: values.clone() for name, values in policy.named_buffers()}
            policy.set_statistics(kwargs["dataset_stats"])
            for name, values in policy.named_buffers():
                if not torch.allclose(values, kept[name], rtol=1e-3, atol=1e-6, equal_nan=True):
                    policy._is_unlike = True
                values.copy_(kept[name])
        return policy

    def use_statistics(self, stats: Statistics) -> None:
        """Take the statistics that states and actions are normalised by from now on."""
        self.set_statistics(stats)
        self._is_unlike = False

    def set_statistics(self, stats: Statistics) -> None:
        """Set the buffers."""
        raise NotImplementedError

    def train(self, mode: bool = True) -> Self:
        """Go to training mode, or to evaluation mode."""
        if mode and self._is_unlike:
            raise ConfigError(
                f"A part of the weights of this {self.name!r} are statistics of what it was trained on, and this "
                "dataset has others. Fine-tune it by bhd-train: --fine_tune=CHECKPOINT "
                "--fine_tune_statistics=dataset; or continue its run: bhd-train --resume=true."
            )
        parent: Any = super()
        return parent.train(mode)
