"""LeRobot's own dataset and PyTorch's `DataLoader`, for what does not fit into memory; resumes to the same sample."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import torch
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.datasets.sampler import EpisodeAwareSampler
from lerobot.utils.collate import lerobot_collate_fn
from torch import Tensor
from torch.utils.data import DataLoader

from bhd_lerobot.data.order import BatchOrder
from bhd_lerobot.runs.config_train import BhdTrainConfig


def open_stock(
    config: BhdTrainConfig,
    meta: LeRobotDatasetMetadata,
    episodes: Sequence[int],
    delta_timestamps: Mapping[str, Sequence[float]] | None,
    image_transforms: Any,
) -> LeRobotDataset:
    """Return LeRobot's dataset as its own training opens it."""
    return LeRobotDataset(
        meta.repo_id,
        root=meta.root,
        episodes=None if len(episodes) == meta.total_episodes else list(episodes),
        delta_timestamps=None if delta_timestamps is None else {key: list(t) for key, t in delta_timestamps.items()},
        image_transforms=image_transforms,
        revision=config.dataset.revision,
        video_backend=config.dataset.video_backend,
        return_uint8=True,
        depth_output_unit=config.dataset.depth_output_unit,
        tolerance_s=config.tolerance_s,
    )


class StockLoader:
    """Batches in a given order, loaded ahead by worker processes; the position counts what was handed out."""

    def __init__(
        self, dataset: LeRobotDataset, order: BatchOrder, config: BhdTrainConfig, device: torch.device
    ) -> None:
        """Prepare it.

        Args:
            dataset: where samples come from.
            order: of the batches.
            config: number of workers and how they work.
            device: where batches are put.
        """
        self.dataset, self.order, self.config, self.device = dataset, order, config, device
        self._done = 0

    @classmethod
    def for_training(
        cls,
        dataset: LeRobotDataset,
        config: BhdTrainConfig,
        seed: int,
        drop_n_last_frames: int,
        weights: Tensor | None,
        *,
        device: torch.device,
        rank: int,
        world_size: int,
    ) -> "StockLoader":
        """Return shuffled batches; the order is that of `lerobot-train`.

        Args:
            dataset: where samples come from.
            config: batch size and workers.
            seed: decides the order.
            drop_n_last_frames: frames at the end of each episode that no sample starts from.
            weights: how often each sample is drawn, compared with others, shape (N,); None for all alike.
            device: where batches are put.
            rank: this process among `world_size`.
            world_size: processes that train together.
        """
        sampler = EpisodeAwareSampler(
            dataset.meta.episodes["dataset_from_index"],
            dataset.meta.episodes["dataset_to_index"],
            episode_indices_to_use=dataset.episodes,
            drop_n_last_frames=drop_n_last_frames,
            absolute_to_relative_idx=dataset.absolute_to_relative_idx,
        )
        samples = torch.tensor(sampler.indices)
        order = BatchOrder(
            samples,
            config.batch_size,
            seed,
            weights=None if weights is None else weights[samples],
            rank=rank,
            world_size=world_size,
        )
        return cls(dataset, order, config, device)

    def __len__(self) -> int:
        """Return the number of batches of a full epoch."""
        return len(self.order)

    def __iter__(self) -> Iterator[dict[str, Any]]:
        """Return the batches of the epoch, or of what is left of it."""
        workers = self.config.num_workers
        loader = DataLoader(
            self.dataset,
            batch_sampler=[indices.tolist() for indices in self.order],
            num_workers=workers,
            # Of its own: from the common one, a resumed run would draw once more than one that was never interrupted.
            generator=torch.Generator().manual_seed(self.order.seed + self._done),
            pin_memory=self.device.type == "cuda",
            collate_fn=lerobot_collate_fn if self.dataset.meta.has_language_columns else None,
            prefetch_factor=self.config.prefetch_factor if workers else None,
            multiprocessing_context=self.config.dataloader_multiprocessing_context if workers else None,
        )
        for batch in loader:
            self._done += 1
            yield {key: one.to(self.device) if isinstance(one, Tensor) else one for key, one in batch.items()}

    def state_dict(self) -> dict[str, Any]:
        """Return how many batches were handed out."""
        return {"batches": self._done}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on after so many batches."""
        self._done = int(state["batches"])
        self.order.seek(self._done)
