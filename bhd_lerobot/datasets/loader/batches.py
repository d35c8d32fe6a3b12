"""Batches for training, in an order that can be taken up again."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from bhd_lerobot.datasets.loader.gather import Batch
from bhd_lerobot.datasets.loader.order import BatchOrder
from bhd_lerobot.datasets.loader.table_dataset import TableDataset
from bhd_lerobot.errors import ConfigError


@dataclass(frozen=True)
class Placing:
    """Where batches are put.

    Attributes:
        device: None leaves them where they are.
        pin: go through page-locked memory, from which a GPU copies while the program goes on; without a GPU, nothing.
    """

    device: torch.device | str | None = None
    pin: bool = False

    def __call__(self, batch: Batch) -> Batch:
        """Return the batch there."""
        pin = self.pin and torch.cuda.is_available()
        if self.device is None and not pin:
            return batch
        placed: Batch = {}
        for key, value in batch.items():
            if isinstance(value, Tensor):
                source = value.pin_memory() if pin else value
                placed[key] = source if self.device is None else source.to(self.device, non_blocking=pin)
            else:
                placed[key] = value
        return placed


class Loader:
    """What a training loop needs: batches, epoch by epoch, in an order that can be taken up again.

    Iterating gives one epoch; iterating again gives the next. `cycle` never ends. The order is that of stock
    `lerobot-train` for the same seed. `state_dict` may be taken after any batch.

    Attributes:
        dataset: where the samples come from.
        batch_size: samples in a batch of this rank.
        order: which samples, when.
        place: puts a batch where it is needed.
    """

    def __init__(self, dataset: Any, order: BatchOrder, placing: Placing) -> None:
        """Keep the parts."""
        self.dataset, self.order, self.batch_size, self.place = dataset, order, order.batch_size, placing

    @property
    def dataset_meta(self) -> Any:
        """LeRobot's metadata of the dataset."""
        return self.dataset.meta

    @property
    def stats(self) -> Any:
        """Statistics of the whole dataset, for normalisation."""
        return self.dataset.meta.stats

    def __len__(self) -> int:
        """Return the number of batches in an epoch."""
        return len(self.order)

    def __iter__(self) -> Iterator[Batch]:
        """Return the batches of the next epoch, or of the rest of the one that `load_state_dict` set."""
        return self.order.follow(self._fetch)

    def cycle(self) -> Iterator[Batch]:
        """Return batches for ever, epoch after epoch."""
        while True:
            yield from self

    def state_dict(self) -> dict[str, Any]:
        """Return where the order is, after the last batch that was served: `epoch` and `position` in samples."""
        return self.order.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on where `state_dict` was taken.

        Raises:
            ConfigError: the state is of another dataset.
        """
        self.order.load_state_dict(state)

    def seek(self, batches: int) -> None:
        """Go to where the order is after so many batches of this rank, for a training that stored only its step."""
        self.order.seek(batches)

    def _fetch(self, batches: Iterator[Tensor]) -> Iterator[Batch]:
        raise NotImplementedError


class BatchLoader(Loader):
    """Batches of a `TableDataset`, gathered from memory."""

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
        samples: Tensor | None = None,
    ) -> None:
        """Prepare the order.

        Args:
            dataset: where the samples come from.
            batch_size: samples in a batch of this rank.
            seed: decides the order, with the number of the epoch.
            shuffle: False serves the samples in the order of the dataset, and ignores weights.
            drop_last: leave an incomplete batch out.
            weights: relative frequency of each sample, shape (N,); None takes those of the dataset.
            device: where batches are put; None leaves them where they are.
            rank: this process among `world_size`.
            world_size: processes that train together.
            pin: page-locked memory, from which a GPU copies while the program goes on.
            drop_n_last_frames: frames at the end of each episode that no sample starts from; some policies ask for it.
            samples: indices of the samples to serve, shape (M,); None means all.

        Raises:
            ConfigError: a value out of range, or nothing left to draw.
        """
        if samples is None:
            samples = first_frames(dataset, drop_n_last_frames)
        weights = dataset.weights if weights is None else weights
        order = BatchOrder(
            samples,
            batch_size,
            seed,
            shuffle=shuffle,
            drop_last=drop_last,
            weights=weights[samples] if weights is not None and shuffle else None,
            rank=rank,
            world_size=world_size,
        )
        super().__init__(dataset, order, Placing(device, pin))

    @classmethod
    def of(cls, dataset: TableDataset, order: BatchOrder, placing: Placing) -> "BatchLoader":
        """Return batches of a dataset in an order that was made before."""
        loader = cls.__new__(cls)
        Loader.__init__(loader, dataset, order, placing)
        return loader

    def _fetch(self, batches: Iterator[Tensor]) -> Iterator[Batch]:
        for indices in batches:
            yield self.place(self.dataset.batch(indices))


def first_frames(dataset: TableDataset, drop_n_last_frames: int = 0) -> Tensor:
    """Return `ordered_samples` of a dataset in memory."""
    return ordered_samples(dataset.table.columns["index"][dataset.rows], dataset.meta, drop_n_last_frames)


def ordered_samples(index: Tensor, meta: Any, drop_n_last_frames: int = 0) -> Tensor:
    """Return the samples that a batch may contain, in the order of the episodes, shape (M,), int64.

    Args:
        index: number of each sample's frame in the whole dataset, shape (N,).
        meta: the dataset.
        drop_n_last_frames: frames at the end of each episode that no sample starts from.

    Raises:
        ConfigError: nothing is left, or the number is negative.
    """
    if drop_n_last_frames < 0:
        raise ConfigError(f"drop_n_last_frames must not be negative; got {drop_n_last_frames}.")
    ends = torch.as_tensor(meta.episodes["dataset_to_index"], dtype=torch.int64)
    end = ends[torch.searchsorted(ends, index, right=True)]
    samples = (index + drop_n_last_frames < end).nonzero()[:, 0]
    if not len(samples):
        raise ConfigError(f"drop_n_last_frames={drop_n_last_frames} leaves no frame: all episodes are shorter.")
    return samples[torch.argsort(index[samples], stable=True)]


def per_task_samples(task_index: Tensor, limit: int) -> Tensor:
    """Return at most about `limit` samples, the first ones of every task, as LeRobot chooses them for `eval_steps`.

    Args:
        task_index: task of every sample, shape (N,).
        limit: samples in all; 0 means no limit.
    """
    if limit <= 0:
        return torch.arange(len(task_index))
    tasks: Sequence[int] = torch.unique(task_index).tolist()
    each = max(1, limit // len(tasks))
    return torch.cat([(task_index == task).nonzero()[:each, 0] for task in tasks])
