"""A drop-in for `LeRobotDataset` in training: whole batches by indexed gathers, identical to LeRobot's samples."""

import copy
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from bhd_lerobot.datasets.loader.frame_cache import FrameCache, check_memory
from bhd_lerobot.datasets.loader.gather import Batch, Gatherer, delta_indices
from bhd_lerobot.datasets.loader.source import local_metadata
from bhd_lerobot.datasets.loader.table import FrameTable, checked_episodes
from bhd_lerobot.errors import DatasetError, MemoryBudgetError, unknown_name

if TYPE_CHECKING:
    from bhd_lerobot.stock import LeRobotDatasetMetadata


class TableDataset:
    """A LeRobot dataset that lies in memory: tables as tensors, camera frames decoded.

    `dataset[i]` is what `LeRobotDataset[i]` is, and `dataset.batch(indices)` what PyTorch's default collate makes of
    such samples (LeRobot's collate if there are language columns), key by key, to the last bit.
    """

    def __init__(
        self,
        repo_id: str,
        root: Path | str | None = None,
        episodes: Sequence[int] | None = None,
        delta_timestamps: Mapping[str, Sequence[float]] | None = None,
        *,
        budget_gib: float = 4.0,
        image_transforms: Callable[[Tensor], Tensor] | None = None,
        tolerance_s: float = 1e-4,
        video_backend: str | None = "pyav",
        keep: Collection[str] | None = None,
        sources: Mapping[str, str] | None = None,
        revision: str | None = None,
        return_uint8: bool = False,
        meta: "LeRobotDatasetMetadata | None" = None,
    ) -> None:
        """Read the dataset, from this machine if it is there, as LeRobot does, and decode its images.

        Args:
            delta_timestamps: key -> times relative to the sample [s], multiples of 1 / fps.
            budget_gib: memory that columns and decoded images may take [GiB].
            tolerance_s: by how much a video frame may miss its time [s].
            sources: features whose values are another column's, by name.
            keep: features to serve besides LeRobot's index columns and `task`; None serves all. Cameras that are left
                out are not decoded.
            return_uint8: serve videos as uint8 instead of float32 in [0, 1].

        Raises:
            DatasetError: no such dataset, episode or feature; delta_timestamps that are no multiples of 1 / fps.
            DatasetCorruptError: a file is missing, unreadable or contradicts the metadata.
            UnsupportedDatasetError: a depth camera, or images of more than 8 bits.
            MemoryBudgetError: columns and images do not fit the budget or the memory that is free.
        """
        self.repo_id, self.delta_timestamps, self.tolerance_s = repo_id, delta_timestamps, tolerance_s
        self.meta = local_metadata(repo_id, root, revision, episodes) if meta is None else meta
        self.root, self.revision = self.meta.root, self.meta.revision
        self.image_transforms, self.return_uint8 = image_transforms, return_uint8
        self.episodes = None if episodes is None else list(episodes)
        wanted = checked_episodes(self.meta, episodes)
        cameras = self._served_cameras(keep)
        deltas = delta_indices(self.meta, delta_timestamps, tolerance_s, keep)
        check_memory(self.meta, wanted, cameras, budget_gib, keep)
        try:
            self.table = FrameTable.open(self.meta, wanted, keep, sources)
        except MemoryError as error:
            raise MemoryBudgetError(f"Memory ran out while the columns of {self.root} were read") from error
        self._frames = FrameCache(self.table, cameras, tolerance_s, video_backend or "pyav")
        self._rows: Tensor | None = None  # rows of the samples; None if sample i is row i
        self._store = Gatherer(self.table, self._frames, deltas)

    def _served_cameras(self, keep: Collection[str] | None) -> list[str]:
        unknown = [key for key in keep or () if key not in self.meta.features]
        if unknown:
            raise DatasetError(f"{self.meta.root}: {unknown_name('feature', unknown[0], self.meta.features)}")
        return [key for key in self.meta.camera_keys if keep is None or key in keep]

    @property
    def num_frames(self) -> int:
        """Samples of the selected episodes."""
        return len(self.table) if self._rows is None else len(self._rows)

    @property
    def num_episodes(self) -> int:
        """Selected episodes."""
        return self.meta.total_episodes if self.episodes is None else len(self.episodes)

    @property
    def features(self) -> dict[str, dict[str, Any]]:
        """LeRobot's feature dictionaries."""
        return self.meta.features

    @property
    def fps(self) -> int:
        """Frames per second."""
        return self.meta.fps

    @property
    def camera_keys(self) -> list[str]:
        """Camera features that are served."""
        return list(self._frames.keys)

    @property
    def nbytes(self) -> int:
        """Bytes that columns and decoded images take."""
        return self.table.nbytes + self._frames.nbytes

    @property
    def rows(self) -> Tensor:
        """Row of the table of every sample, shape (N,), int64."""
        return torch.arange(len(self.table)) if self._rows is None else self._rows

    @property
    def absolute_to_relative_idx(self) -> dict[int, int] | None:
        """Number of the frame in the whole dataset -> index of the sample; None if both are the same."""
        index = self.table.columns["index"][self.rows]
        if self.episodes is None and torch.equal(index, torch.arange(len(index))):
            return None
        return dict(zip(index.tolist(), range(len(index)), strict=True))

    def set_image_transforms(self, image_transforms: Callable[[Tensor], Tensor] | None) -> None:
        """Replace the transform of the images."""
        self.image_transforms = image_transforms

    def subset(self, episodes: Sequence[int]) -> "TableDataset":
        """Return a dataset of some of the episodes that shares the memory of this one.

        Raises:
            DatasetError: one of them is not selected here, or none is given.
        """
        if not len(episodes):
            raise DatasetError("A dataset needs at least one episode; none was selected.")
        mine = set(self.table.episodes if self.episodes is None else self.episodes)
        wrong = [episode for episode in episodes if episode not in mine]
        if wrong:
            raise DatasetError(f"Episode {wrong[0]} is not among the {len(mine)} that are loaded.")
        part = copy.copy(self)
        part.episodes = [int(episode) for episode in episodes]
        chosen = torch.tensor(part.episodes)
        part._rows = torch.isin(self.table.columns["episode_index"], chosen).nonzero()[:, 0]
        return part

    def ending_before(self, samples: Tensor) -> "TableDataset":
        """Return a dataset that shares the memory of this one, whose windows end before some of the samples."""
        part = copy.copy(self)
        part._store = self._store.ending_before(self.rows[samples])
        return part

    def __len__(self) -> int:
        return self.num_frames

    def __getitem__(self, index: int | slice) -> Batch | list[Batch]:
        if isinstance(index, slice):
            return [self._sample(i) for i in range(*index.indices(len(self)))]
        return self._sample(int(index))

    def _sample(self, index: int) -> Batch:
        if not -len(self) <= index < len(self):
            raise IndexError(f"Sample {index} of a dataset with {len(self)} samples.")
        batch = self.batch(torch.tensor([index % len(self)]))
        row = int(self.rows[index])
        sample = {key: values[0] for key, values in batch.items()}
        if not self.table.nested:
            return sample
        sample |= {key: column[row].as_py() for key, column in self.table.nested.items()}
        own = {key: sample[key] for key in self.table.keys}
        videos = {key: sample[key] for key in self._frames.keys if key not in own}
        return {**videos, **own, **{key: value for key, value in sample.items() if key not in own}}

    def batch(self, indices: Tensor) -> Batch:
        """Return the samples with these indices as one batch.

        Args:
            indices: shape (B,), int64, each from 0 to len(self) - 1.

        Returns:
            What `default_collate([lerobot_dataset[i] for i in indices])` returns, in memory of its own.
        """
        rows = indices if self._rows is None else self._rows[indices]
        batch = self._store.gather(rows, self.return_uint8) | self._language(rows)
        if self.image_transforms is not None:
            self._transform(batch, len(indices))
        return batch

    def _language(self, rows: Tensor) -> Batch:
        """Return what LeRobot's collate keeps of language columns: nothing in version 0.6.1, later lists of them."""
        if not self.table.nested:
            return {}
        from bhd_lerobot.stock import lerobot_collate_fn

        columns = self.table.nested.items()
        samples = [{"index": 0} | {key: column[row].as_py() for key, column in columns} for row in rows.tolist()]
        return {key: values for key, values in lerobot_collate_fn(samples).items() if key != "index"}

    def _transform(self, batch: Batch, size: int) -> None:
        # Sample by sample and camera by camera, so that random transforms draw as they do in LeRobot.
        images: dict[str, list[Tensor]] = {key: [] for key in self._frames.keys}
        assert self.image_transforms is not None
        for i in range(size):
            for key, transformed in images.items():
                transformed.append(self.image_transforms(batch[key][i]))
        batch |= {key: torch.stack(transformed) for key, transformed in images.items()}
