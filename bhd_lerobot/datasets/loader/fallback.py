"""Where batches come from: a dataset in memory, or LeRobot's own datasets behind the same interface."""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import torch
from torch import Tensor

from bhd_lerobot.datasets.loader.batches import BatchLoader, Loader, Placing
from bhd_lerobot.datasets.loader.gather import Batch
from bhd_lerobot.datasets.loader.order import BatchOrder
from bhd_lerobot.datasets.loader.table_dataset import TableDataset
from bhd_lerobot.errors import MemoryBudgetError, UnsupportedDatasetError

if TYPE_CHECKING:
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

Transform = Callable[[Tensor], Tensor] | None


@dataclass(frozen=True)
class Serving:
    """How samples are made of a dataset, by whatever source; `make_loader` says what each of it means."""

    delta_timestamps: Mapping[str, Sequence[float]] | None = None
    tolerance_s: float = 1e-4
    video_backend: str | None = "pyav"
    return_uint8: bool = True
    keep: Collection[str] | None = None
    budget_gib: float = 4.0
    num_workers: int = 0

    def stock(self, meta: "LeRobotDatasetMetadata", episodes: Sequence[int]) -> dict[str, Any]:
        """Return the arguments that LeRobot's own datasets take for some episodes."""
        times = self.delta_timestamps
        return {
            "root": meta.root,
            "episodes": None if len(episodes) == meta.total_episodes else list(episodes),
            "delta_timestamps": None if times is None else {key: list(values) for key, values in times.items()},
            "tolerance_s": self.tolerance_s,
            "revision": meta.revision,
            "return_uint8": self.return_uint8,
        }


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
    serving: Serving

    def open(self, episodes: Sequence[int], image_transforms: Transform) -> tuple[Any, dict[str, Tensor]]:
        """Return a dataset of some episodes, and `index` and `task_index` of its samples."""
        from lerobot.datasets.lerobot_dataset import LeRobotDataset

        dataset = LeRobotDataset(
            self.meta.repo_id,
            image_transforms=image_transforms,
            video_backend=self.serving.video_backend,
            **self.serving.stock(self.meta, episodes),
        )
        dataset.meta.stats = self.meta.stats
        columns = dataset.hf_dataset.data
        return dataset, {
            key: torch.from_numpy(columns.column(key).to_numpy()[: len(dataset)].copy())
            for key in ("index", "task_index")
        }

    def loader(self, dataset: Any, order: BatchOrder, placing: Placing) -> Loader:
        """Return batches of it."""
        return LeRobotLoader(dataset, order, placing, self.serving.num_workers)


@dataclass
class StreamedSource:
    """From LeRobot's streaming dataset."""

    meta: "LeRobotDatasetMetadata"
    serving: Serving

    def open(self, episodes: Sequence[int], image_transforms: Transform) -> tuple[Any, dict[str, Tensor]]:
        """Return a dataset of some episodes, and `index` and `task_index` that only count its samples."""
        from lerobot.datasets.streaming_dataset import StreamingLeRobotDataset

        dataset = StreamingLeRobotDataset(
            self.meta.repo_id,
            image_transforms=image_transforms,
            max_num_shards=max(1, self.serving.num_workers),
            **self.serving.stock(self.meta, episodes),
        )
        dataset.meta.stats = self.meta.stats
        begin, end = self.meta.episodes["dataset_from_index"], self.meta.episodes["dataset_to_index"]
        index = torch.cat([torch.arange(begin[episode], end[episode]) for episode in episodes])
        return dataset, {"index": index, "task_index": torch.zeros_like(index)}

    def loader(self, dataset: Any, order: BatchOrder, placing: Placing) -> Loader:
        """Return batches of it."""
        return StreamingLoader(dataset, order, placing, self.serving.num_workers)


def open_source(
    meta: "LeRobotDatasetMetadata", episodes: Sequence[int], serving: Serving, *, streaming: bool = False
) -> tuple[Source, str]:
    """Return where some episodes are read from: memory where they fit, else LeRobot's own dataset.

    Args:
        meta: the dataset.
        episodes: those that are going to be opened.
        serving: how samples are made.
        streaming: read from the Hub while training.

    Returns:
        The source, and why it is not memory; empty if it is.

    Raises:
        DatasetError: the dataset cannot be read, or lacks what is asked for.
    """
    if streaming:
        message = f"{meta.repo_id} is streamed by LeRobot's own dataset; a resumed training sees its samples in "
        return StreamedSource(meta, serving), message + "another order."
    try:
        whole = TableDataset(
            meta.repo_id,
            episodes=None if len(episodes) == meta.total_episodes else episodes,
            delta_timestamps=serving.delta_timestamps,
            budget_gib=serving.budget_gib,
            tolerance_s=serving.tolerance_s,
            video_backend=serving.video_backend,
            keep=serving.keep,
            return_uint8=serving.return_uint8,
            meta=meta,
        )
    except (MemoryBudgetError, UnsupportedDatasetError) as error:
        message = f"{error}. LeRobot's own loader serves the same samples, decoding them anew every time."
        return LeRobotSource(meta, serving), message
    return MemorySource(whole), ""
