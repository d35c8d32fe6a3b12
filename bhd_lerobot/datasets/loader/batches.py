"""Batches for training, in an order that can be resumed: from memory, or by PyTorch's `DataLoader`."""

from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor

from bhd_lerobot.datasets.loader.config import LoaderConfig
from bhd_lerobot.datasets.loader.gather import Batch
from bhd_lerobot.datasets.loader.order import BatchOrder


class Loader:
    """What a training loop needs: batches, epoch by epoch, in an order that can be resumed.

    Iterating gives one epoch; iterating again gives the next. `cycle` never ends. The order is that of stock
    `lerobot-train` for the same seed. `state_dict` may be taken after any batch.

    Attributes:
        dataset: where the samples come from.
        order: which samples, when.
        device: where batches are put; None leaves them in memory.
    """

    def __init__(self, dataset: Any, order: BatchOrder, device: torch.device | str | None = None) -> None:
        self.dataset, self.order = dataset, order
        self.device = None if device is None else torch.device(device)

    def __len__(self) -> int:
        return len(self.order)

    def __iter__(self) -> Iterator[Batch]:
        """Return the batches of the next epoch, or of the rest of the one that `load_state_dict` set."""
        return self.order.follow(lambda batches: map(self._place, self._fetch(batches)))

    def cycle(self) -> Iterator[Batch]:
        """Return batches for ever, epoch after epoch."""
        while True:
            yield from self

    def state_dict(self) -> dict[str, Any]:
        """Return where the order is, after the last batch that was served: `epoch` and `position` in samples."""
        return self.order.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue where `state_dict` was taken.

        Raises:
            ConfigError: the state is of another dataset.
        """
        self.order.load_state_dict(state)

    def seek(self, batches: int) -> None:
        """Go to where the order is after so many batches of this rank, for a training that stored only its step."""
        self.order.seek(batches)

    def _fetch(self, batches: Iterator[Tensor]) -> Iterator[Batch]:
        raise NotImplementedError

    def _place(self, batch: Batch) -> Batch:
        if self.device is None:
            return batch
        # From page-locked memory a GPU copies while the program continues.
        pin = self.device.type == "cuda"
        return {
            key: (value.pin_memory() if pin else value).to(self.device, non_blocking=pin)
            if isinstance(value, Tensor)
            else value
            for key, value in batch.items()
        }


class BatchLoader(Loader):
    """Batches of a `TableDataset`, gathered from memory."""

    def _fetch(self, batches: Iterator[Tensor]) -> Iterator[Batch]:
        return map(self.dataset.batch, batches)


class LeRobotLoader(Loader):
    """Batches of a `LeRobotDataset`, by PyTorch's `DataLoader`, in the same order as from memory."""

    def __init__(self, dataset: Any, order: BatchOrder, config: LoaderConfig) -> None:
        super().__init__(dataset, order, config.device)
        from bhd_lerobot.stock import lerobot_collate_fn

        self._epoch = _Epoch()
        self._loader = torch.utils.data.DataLoader(
            dataset,
            batch_sampler=self._epoch,
            num_workers=config.num_workers,
            prefetch_factor=config.prefetch_factor if config.num_workers else None,
            collate_fn=lerobot_collate_fn if dataset.meta.has_language_columns else None,
            persistent_workers=config.persistent_workers and config.num_workers > 0,
            # Without it, each new iterator draws from the common generator, and a resumed run makes one more of them.
            generator=torch.Generator().manual_seed(0),
        )

    def _fetch(self, batches: Iterator[Tensor]) -> Iterator[Batch]:
        self._epoch.batches = [indices.tolist() for indices in batches]
        return iter(self._loader)


class _Epoch:
    """The batches of the current epoch, for a `DataLoader` whose workers outlive it."""

    def __init__(self) -> None:
        self.batches: list[list[int]] = []

    def __iter__(self) -> Iterator[list[int]]:
        return iter(self.batches)

    def __len__(self) -> int:
        return len(self.batches)
