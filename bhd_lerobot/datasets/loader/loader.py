"""From the options of a training to its batches: from memory where they fit, else by LeRobot's own loader."""

import logging
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from bhd_lerobot.datasets.loader.batches import (
    BatchLoader,
    Loader,
    Placing,
    first_frames,
    ordered_samples,
    per_task_samples,
)
from bhd_lerobot.datasets.loader.check import check
from bhd_lerobot.datasets.loader.fallback import Serving, open_source
from bhd_lerobot.datasets.loader.gather import Batch
from bhd_lerobot.datasets.loader.order import BatchOrder
from bhd_lerobot.datasets.loader.selection import EpisodeFilter, intervention_weights, split_episodes
from bhd_lerobot.datasets.loader.source import local_metadata
from bhd_lerobot.datasets.loader.table import FrameTable, checked_episodes
from bhd_lerobot.datasets.loader.table_dataset import TableDataset
from bhd_lerobot.errors import ConfigError, MemoryBudgetError, UnsupportedDatasetError

__all__ = [
    "Batch",
    "BatchLoader",
    "EpisodeFilter",
    "FrameTable",
    "Loader",
    "Loaders",
    "MemoryBudgetError",
    "TableDataset",
    "UnsupportedDatasetError",
    "check",
    "first_frames",
    "intervention_weights",
    "make_loader",
    "split_episodes",
]


class Loaders(NamedTuple):
    """What a training reads.

    Attributes:
        dataset: the training samples: a `TableDataset`, or LeRobot's dataset after a fallback.
        train: its batches, shuffled.
        held_out: batches of the episodes that are held out, in order; None if none are.
        message: what a user should know: why LeRobot's own loader is used; empty if it is not.
    """

    dataset: Any
    train: Loader
    held_out: Loader | None
    message: str


def make_loader(
    repo_id: str,
    *,
    batch_size: int,
    seed: int = 0,
    root: Path | str | None = None,
    revision: str | None = None,
    episodes: Sequence[int] | None = None,
    selection: EpisodeFilter | None = None,
    intervention_weight: float = 1.0,
    eval_split: float = 0.0,
    hold_out: str = "episode",
    max_eval_samples: int = 0,
    delta_timestamps: Mapping[str, Sequence[float]] | None = None,
    drop_n_last_frames: int = 0,
    image_transforms: Callable[[Tensor], Tensor] | None = None,
    use_imagenet_stats: bool = True,
    return_uint8: bool = True,
    tolerance_s: float = 1e-4,
    video_backend: str | None = "pyav",
    keep: Collection[str] | None = None,
    budget_gib: float = 4.0,
    streaming: bool = False,
    num_workers: int = 0,
    drop_last: bool = False,
    device: torch.device | str | None = None,
    pin: bool = False,
    rank: int = 0,
    world_size: int = 1,
    say: Callable[[str], None] | None = None,
) -> Loaders:
    """Return the batches of a training and of what it holds out.

    Both share one copy of the data in memory. If that does not fit, or the dataset has something that is not kept in
    memory, the same samples come in the same order from LeRobot's own dataset and PyTorch's `DataLoader`, and a message
    says so.

    Args:
        repo_id: name of the dataset.
        batch_size: samples in a batch of this rank.
        seed: decides the order, with the number of the epoch; for the same seed it is that of `lerobot-train`.
        root: folder of the dataset; None looks where LeRobot keeps datasets.
        revision: version of the dataset on the Hub.
        episodes: to choose from; None means all.
        selection: which episodes; None means all.
        intervention_weight: how often frames in which somebody intervened are drawn, compared with others; 0 drops
            them. Held-out samples are not weighted.
        eval_split: share of the episodes that is held out, from 0 to below 1.
        hold_out: of what the share is meant: `episode` or `instruction`; see `split_episodes`.
        max_eval_samples: at most about so many held-out samples, the first of each task; 0 means all.
        delta_timestamps: key -> times relative to the sample [s], multiples of 1 / fps.
        drop_n_last_frames: frames at the end of each episode that no training sample starts from.
        image_transforms: for training images only.
        use_imagenet_stats: normalise images with the statistics of ImageNet.
        return_uint8: serve videos as uint8, which `lerobot-train` divides by 255 afterwards, instead of float32.
        tolerance_s: by how much a video frame may miss its time [s].
        video_backend: LeRobot's decoder whose images are wanted.
        keep: features to serve; None serves all. After a fallback all are served.
        budget_gib: memory that columns and decoded images may take [GiB].
        streaming: read from the Hub while training, with LeRobot's own dataset.
        num_workers: processes of PyTorch's `DataLoader`, after a fallback.
        drop_last: leave an incomplete batch out of the training's epochs.
        device: where batches are put; None leaves them in memory.
        pin: copy through page-locked memory.
        rank: this process among `world_size`.
        world_size: processes that train together.
        say: gets the message once; None writes it to the log as a warning.

    Raises:
        ConfigError: a value out of range.
        DatasetError: no such dataset, or nothing in it that was asked for; the message names what is there.
    """
    meta = local_metadata(repo_id, root, revision, [] if streaming else episodes)
    chosen = checked_episodes(meta, episodes) if selection is None else selection.select(meta, episodes)
    train, held_out = split_episodes(meta, chosen, eval_split, hold_out)
    weights = intervention_weights(meta, train, intervention_weight)
    if streaming and (held_out or weights is not None):
        raise ConfigError("Streaming has no held-out episodes and no weights: set eval_split to 0, the weight to 1.")
    if use_imagenet_stats:
        imagenet_stats(meta)
    serving = Serving(delta_timestamps, tolerance_s, video_backend, return_uint8, keep, budget_gib, num_workers)
    source, message = open_source(meta, chosen, serving, streaming=streaming)
    if message:
        (say or logging.getLogger(__name__).warning)(message)
    placing = Placing(device, pin)
    dataset, columns = source.open(train, image_transforms)
    samples = ordered_samples(columns["index"], meta, drop_n_last_frames)
    drawn = None if weights is None else weights[samples]
    order = BatchOrder(samples, batch_size, seed, drop_last=drop_last, weights=drawn, rank=rank, world_size=world_size)
    loader = source.loader(dataset, order, placing)
    if not held_out:
        return Loaders(dataset, loader, None, message)
    rest, columns = source.open(held_out, None)
    samples = per_task_samples(columns["task_index"], max_eval_samples)
    order = BatchOrder(samples, batch_size, 0, shuffle=False, rank=rank, world_size=world_size)
    return Loaders(dataset, loader, source.loader(rest, order, placing), message)


def imagenet_stats(meta: Any) -> None:
    """Put the statistics of ImageNet's images in place of those of a dataset's cameras, as LeRobot's training does."""
    from lerobot.utils.constants import IMAGENET_STATS

    for key in meta.camera_keys if meta.stats else ():
        if key not in meta.depth_keys:
            for name, values in IMAGENET_STATS.items():
                meta.stats[key][name] = torch.tensor(values, dtype=torch.float32)
