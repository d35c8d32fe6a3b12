"""Where batches come from: a dataset in memory, or LeRobot's own datasets behind the same interface."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import torch
from torch import Tensor

from bhd_lerobot.data.batches import BatchLoader, Loader, Placing
from bhd_lerobot.data.gather import Batch
from bhd_lerobot.data.order import BatchOrder
from bhd_lerobot.data.table_dataset import TableDataset

if TYPE_CHECKING:
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

Transform = Callable[[Tensor], Tensor] | None
Times = Mapping[str, Sequence[float]] | None


class LeRobotLoader(Loader):
    """Batches of a `LeRobotDataset`, by PyTorch's `DataLoader`, in the same order as from memory."""

    def __init__(
        self,
        dataset: Any,
        order: BatchOrder,
        placing: Placing,
        num_workers: int = 0,
    ) -> None:
        """Prepare.

        Args:
            dataset: the `LeRobotDataset`.
            order: which of its samples, when.
            placing: where batches are put.
            num_workers: processes that decode.
        """
        super().__init__(dataset, order, placing)
        self._turn = _Turn()
        self._loader = torch.utils.data.DataLoader(
            dataset,
            batch_sampler=self._turn,
            num_workers=num_workers,
            collate_fn=collate_function(dataset.meta),
            persistent_workers=num_workers > 0,
        )

    def _fetch(self, batches: Iterator[Tensor]) -> Iterator[Batch]:
        self._turn.batches = [indices.tolist() for indices in batches]
        for batch in self._loader:
            yield self.place(batch)


class StreamingLoader(Loader):
    """Batches of LeRobot's streaming dataset. It decides the order itself, so a resumed training sees another one."""

    def __init__(self, dataset: Any, order: BatchOrder, placing: Placing, num_workers: int = 0) -> None:
        """Prepare; of `order` only the number of batches counts. See `LeRobotLoader`."""
        super().__init__(dataset, order, placing)
        self._loader = torch.utils.data.DataLoader(
            dataset,
            batch_size=order.batch_size,
            num_workers=num_workers,
            collate_fn=collate_function(dataset.meta),
        )

    def _fetch(self, batches: Iterator[Tensor]) -> Iterator[Batch]:
        for batch in self._loader:
            yield self.place(batch)


class _Turn:
    """The batches of the epoch that is under way, for a `DataLoader` whose workers outlive it."""

    def __init__(self) -> None:
        self.batches: list[list[int]] = []

    def __iter__(self) -> Iterator[list[int]]:
        return iter(self.batches)

    def __len__(self) -> int:
        return len(self.batches)


def collate_function(meta: Any) -> Any:
    """Return what LeRobot collates samples of a dataset with; None is PyTorch's default."""
    if not meta.has_language_columns:
        return None
    from lerobot.utils.collate import lerobot_collate_fn

    return lerobot_collate_fn


class Source(Protocol):
    """Opens some episodes of a dataset, and serves them."""

    def open(self, episodes: Sequence[int], image_transforms: Transform) -> tuple[Any, dict[str, Tensor]]:
        """Return a dataset of some episodes, and `index` and `task_index` of its samples."""
        ...

    def loader(self, dataset: Any, order: BatchOrder, placing: Placing) -> Loader:
        """Return batches of it."""
        ...


@dataclass
class MemorySource:
    """From a dataset in memory; its parts share it."""

    whole: TableDataset

    def open(self, episodes: Sequence[int], image_transforms: Transform) -> tuple[TableDataset, dict[str, Tensor]]:
        """Return a dataset of some episodes, and `index` and `task_index` of its samples."""
        part = self.whole.subset(episodes) if len(episodes) < self.whole.num_episodes else self.whole
        part.set_image_transforms(image_transforms)
        return part, {key: part.table.columns[key][part.rows] for key in ("index", "task_index")}

    def loader(self, dataset: TableDataset, order: BatchOrder, placing: Placing) -> Loader:
        """Return batches of it."""
        return BatchLoader.of(dataset, order, placing)


@dataclass
class LeRobotSource:
    """From LeRobot's own dataset, which decodes each image when it is asked for."""

    meta: "LeRobotDatasetMetadata"
    delta_timestamps: Times
    tolerance_s: float
    video_backend: str | None
    return_uint8: bool
    num_workers: int

    def open(self, episodes: Sequence[int], image_transforms: Transform) -> tuple[Any, dict[str, Tensor]]:
        """Return a dataset of some episodes, and `index` and `task_index` of its samples."""
        from lerobot.datasets.lerobot_dataset import LeRobotDataset

        dataset = LeRobotDataset(
            self.meta.repo_id,
            root=self.meta.root,
            episodes=None if len(episodes) == self.meta.total_episodes else list(episodes),
            delta_timestamps=_lists(self.delta_timestamps),
            image_transforms=image_transforms,
            tolerance_s=self.tolerance_s,
            revision=self.meta.revision,
            video_backend=self.video_backend,
            return_uint8=self.return_uint8,
        )
        dataset.meta.stats = self.meta.stats
        columns = dataset.hf_dataset.data
        return dataset, {
            key: torch.from_numpy(columns.column(key).to_numpy()[: len(dataset)].copy())
            for key in ("index", "task_index")
        }

    def loader(self, dataset: Any, order: BatchOrder, placing: Placing) -> Loader:
        """Return batches of it."""
        return LeRobotLoader(dataset, order, placing, self.num_workers)


@dataclass
class StreamedSource:
    """From LeRobot's streaming dataset."""

    meta: "LeRobotDatasetMetadata"
    delta_timestamps: Times
    tolerance_s: float
    return_uint8: bool
    num_workers: int

    def open(self, episodes: Sequence[int], image_transforms: Transform) -> tuple[Any, dict[str, Tensor]]:
        """Return a dataset of some episodes, and `index` and `task_index` that only count its samples."""
        from lerobot.datasets.streaming_dataset import StreamingLeRobotDataset

        dataset = StreamingLeRobotDataset(
            self.meta.repo_id,
            root=self.meta.root,
            episodes=None if len(episodes) == self.meta.total_episodes else list(episodes),
            delta_timestamps=_lists(self.delta_timestamps),
            image_transforms=image_transforms,
            tolerance_s=self.tolerance_s,
            revision=self.meta.revision,
            max_num_shards=max(1, self.num_workers),
            return_uint8=self.return_uint8,
        )
        dataset.meta.stats = self.meta.stats
        begin, end = self.meta.episodes["dataset_from_index"], self.meta.episodes["dataset_to_index"]
        index = torch.cat([torch.arange(begin[episode], end[episode]) for episode in episodes])
        return dataset, {"index": index, "task_index": torch.zeros_like(index)}

    def loader(self, dataset: Any, order: BatchOrder, placing: Placing) -> Loader:
        """Return batches of it."""
        return StreamingLoader(dataset, order, placing, self.num_workers)


def _lists(times: Times) -> dict[str, list[float]] | None:
    return None if times is None else {key: list(values) for key, values in times.items()}
