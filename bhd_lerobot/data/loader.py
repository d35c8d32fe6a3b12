"""Batches for training, from memory; in place of PyTorch's `DataLoader` over a `LeRobotDataset`."""

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from bhd_lerobot.data.gather import Batch
from bhd_lerobot.data.order import BatchOrder
from bhd_lerobot.data.table import FrameTable
from bhd_lerobot.data.table_dataset import TableDataset

if TYPE_CHECKING:
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

__all__ = ["Batch", "BatchLoader", "FrameTable", "TableDataset"]


class BatchLoader:
    """Batches of a `TableDataset` for training; in place of PyTorch's `DataLoader`.

    Iterating gives one epoch; iterating again gives the next. `cycle` never ends. The order is that of stock
    `lerobot-train` for the same seed. `state_dict` may be taken after any batch.
    """

    def __init__(
        self,
        dataset: TableDataset,
        batch_size: int,
        seed: int = 0,
        shuffle: bool = True,
        *,
        drop_last: bool = False,
        weights: Tensor | None = None,
        device: torch.device | str | None = None,
        rank: int = 0,
        world_size: int = 1,
        pin: bool = False,
        drop_n_last_frames: int = 0,
    ) -> None:
        """Prepare the order.

        Args:
            dataset: where the samples come from.
            batch_size: samples in a batch of this rank.
            seed: decides the order, with the number of the epoch.
            shuffle: False serves the samples in the order of the dataset.
            drop_last: leave an incomplete batch out.
            weights: relative frequency of each sample, shape (N,); None takes those of the dataset.
            device: where batches are put; None leaves them where they are.
            rank: this process among `world_size`.
            world_size: processes that train together.
            pin: page-locked memory, from which a GPU copies while the program goes on.
            drop_n_last_frames: frames at the end of each episode that no sample starts from; some policies ask for it.

        Raises:
            ConfigError: a value out of range, or nothing left to draw.
        """
        samples = first_frames(dataset, drop_n_last_frames)
        weights = dataset.weights if weights is None and shuffle else weights
        self.dataset, self.batch_size = dataset, batch_size
        self.device = None if device is None else torch.device(device)
        self.pin = pin and torch.cuda.is_available()
        self.order = BatchOrder(
            samples,
            batch_size,
            seed,
            shuffle=shuffle,
            drop_last=drop_last,
            weights=None if weights is None else weights[samples],
            rank=rank,
            world_size=world_size,
        )

    @property
    def dataset_meta(self) -> "LeRobotDatasetMetadata":
        """LeRobot's metadata of the dataset."""
        return self.dataset.meta

    @property
    def stats(self) -> Any:
        """Statistics of the dataset, for normalisation."""
        return self.dataset.meta.stats

    def __len__(self) -> int:
        """Return the number of batches in an epoch."""
        return len(self.order)

    def __iter__(self) -> Iterator[Batch]:
        """Return the batches of the next epoch, or of the rest of the one that `load_state_dict` set."""
        return (self._place(self.dataset.batch(indices)) for indices in iter(self.order))

    def cycle(self) -> Iterator[Batch]:
        """Return batches for ever, epoch after epoch."""
        while True:
            yield from self

    def state_dict(self) -> dict[str, Any]:
        """Return where the order is, after the last batch that was served."""
        return self.order.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on where `state_dict` was taken."""
        self.order.load_state_dict(state)

    def _place(self, batch: Batch) -> Batch:
        if self.pin:
            batch = {key: value.pin_memory() if isinstance(value, Tensor) else value for key, value in batch.items()}
        if self.device is not None:
            batch = {
                key: value.to(self.device, non_blocking=self.pin) if isinstance(value, Tensor) else value
                for key, value in batch.items()
            }
        return batch


def first_frames(dataset: TableDataset, drop_n_last_frames: int = 0) -> Tensor:
    """Return the indices of the samples that a batch may contain, in the order of the episodes, shape (M,)."""
    rows = dataset.rows
    samples = torch.arange(len(rows))
    if drop_n_last_frames:
        samples = samples[rows + drop_n_last_frames <= dataset.table.last[rows]]
    return samples[torch.argsort(dataset.table.columns["index"][rows[samples]], stable=True)]
