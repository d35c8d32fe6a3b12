"""From the configuration of a training to its batches: from memory where they fit, else by LeRobot's own loader."""

import logging
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from bhd_lerobot.datasets.format.features import ACTION, EXPERT_ACTION
from bhd_lerobot.datasets.loader.batches import BatchLoader, LeRobotLoader, Loader
from bhd_lerobot.datasets.loader.check import check
from bhd_lerobot.datasets.loader.config import LoaderConfig
from bhd_lerobot.datasets.loader.gather import Batch
from bhd_lerobot.datasets.loader.order import BatchOrder
from bhd_lerobot.datasets.loader.selection import EpisodeFilter, frame_weights, split_episodes
from bhd_lerobot.datasets.loader.source import local_metadata
from bhd_lerobot.datasets.loader.table import FrameTable, checked_episodes
from bhd_lerobot.datasets.loader.table_dataset import TableDataset
from bhd_lerobot.errors import ConfigError, DatasetError, MemoryBudgetError, UnsupportedDatasetError, quoted

if TYPE_CHECKING:
    from bhd_lerobot.stock import LeRobotDatasetMetadata

__all__ = [
    "Batch",
    "EpisodeFilter",
    "FrameTable",
    "Loader",
    "LoaderConfig",
    "Loaders",
    "MemoryBudgetError",
    "TableDataset",
    "UnsupportedDatasetError",
    "check",
    "frame_weights",
    "make_loader",
    "split_episodes",
]

_log = logging.getLogger(__name__)


class Loaders(NamedTuple):
    """What a training reads.

    Attributes:
        dataset: the training samples: a `TableDataset`, or LeRobot's dataset after a fallback.
        train: its batches, shuffled.
        held_out: batches of the episodes that are held out, in order; None if none are.
        message: why LeRobot's own loader is used; empty if it is not.
    """

    dataset: Any
    train: Loader
    held_out: Loader | None
    message: str


def make_loader(
    repo_id: str,
    config: LoaderConfig,
    *,
    root: Path | str | None = None,
    revision: str | None = None,
    meta: "LeRobotDatasetMetadata | None" = None,
    report: Callable[[str], None] = _log.warning,
) -> Loaders:
    """Return the batches of a training and of what it holds out.

    Both share one copy of the data in memory. If that does not fit, or the dataset has something that is not kept in
    memory, the same samples come in the same order from LeRobot's own dataset and PyTorch's `DataLoader`, and a message
    reports it.

    Args:
        repo_id: name of the dataset.
        config: which samples, in which order and form.
        root: folder of the dataset; None means LeRobot's folder for `repo_id`.
        revision: version of the dataset on the Hub.
        meta: the dataset's metadata where it is open already, with the wanted files on this machine; `root` and
            `revision` are not used then.
        report: gets the message once.

    Raises:
        ConfigError: `drop_n_last_frames` or the weights leave no sample.
        DatasetError: no such dataset, episode or feature; the message names what there is.
    """
    if meta is None:
        meta = local_metadata(repo_id, root, revision, config.episodes)
    selection, episodes = config.selection, config.episodes
    chosen = checked_episodes(meta, episodes) if selection is None else selection.select(meta, episodes)
    train, held_out = split_episodes(meta, chosen, config.eval_split, config.hold_out)
    weights = frame_weights(meta, train, intervention=config.intervention_weight, learner=config.learner_weight)
    if config.use_imagenet_stats:
        imagenet_stats(meta)
    if config.expert_action:
        expert_stats(meta)
    whole, reason = _in_memory(meta, chosen, config)

    def load(part: Sequence[int], transforms: Any, choose: Callable[[Tensor, Tensor], Tensor], **order: Any) -> Loader:
        if whole is None:
            dataset = _lerobot_dataset(meta, part, config, transforms, reason)
            columns = (dataset.hf_dataset.data.column(key) for key in ("index", "task_index"))
            index, task = (torch.from_numpy(column.to_numpy()[: len(dataset)].copy()) for column in columns)
        else:
            dataset = whole.subset(part) if len(part) < whole.num_episodes else whole
            dataset.set_image_transforms(transforms)
            index, task = (dataset.table.columns[key][dataset.rows] for key in ("index", "task_index"))
        samples = choose(index, task)
        if (weights := order.get("weights")) is not None:
            if (left_out := weights == 0).any():
                dataset = _ending_before(dataset, left_out, config, reason)
            order["weights"] = weights[samples]
        deal = BatchOrder(samples, config.batch_size, rank=config.rank, world_size=config.world_size, **order)
        if whole is None:
            return LeRobotLoader(dataset, deal, config)
        return BatchLoader(dataset, deal, config.device)

    training = load(
        train,
        config.image_transforms,
        lambda index, task: _first_frames(index, meta, config.drop_n_last_frames),
        seed=config.seed,
        drop_last=config.drop_last,
        weights=weights,
    )
    message = reason and f"{reason}. LeRobot's own loader serves the same samples, decoding them anew every time."
    if message:
        report(message)
    rest = None
    if held_out:
        rest = load(held_out, None, lambda index, task: _per_task(task, config.max_eval_samples), seed=0, shuffle=False)
    return Loaders(training.dataset, training, rest, message)


def _in_memory(
    meta: "LeRobotDatasetMetadata", episodes: Sequence[int], config: LoaderConfig
) -> tuple[TableDataset | None, str]:
    """Return the dataset in memory; None, and why, if it does not fit or has something that is not kept there."""
    try:
        dataset = TableDataset(
            meta.repo_id,
            episodes=None if len(episodes) == meta.total_episodes else episodes,
            delta_timestamps=config.delta_timestamps,
            budget_gib=config.budget_gib,
            tolerance_s=config.tolerance_s,
            video_backend=config.video_backend,
            keep=config.keep,
            sources={ACTION: EXPERT_ACTION} if config.expert_action else None,
            return_uint8=config.return_uint8,
            meta=meta,
        )
    except (MemoryBudgetError, UnsupportedDatasetError) as error:
        return None, str(error)
    return dataset, ""


def _lerobot_dataset(
    meta: "LeRobotDatasetMetadata", episodes: Sequence[int], config: LoaderConfig, transforms: Any, reason: str
) -> Any:
    from bhd_lerobot.stock import LeRobotDataset

    times = config.delta_timestamps
    dataset = LeRobotDataset(
        meta.repo_id,
        root=meta.root,
        episodes=None if len(episodes) == meta.total_episodes else list(episodes),
        image_transforms=transforms,
        delta_timestamps=None if times is None else {key: list(values) for key, values in times.items()},
        tolerance_s=config.tolerance_s,
        revision=meta.revision,
        video_backend=config.video_backend,
        return_uint8=config.return_uint8,
        depth_output_unit=config.depth_output_unit,
    )
    dataset.meta.stats, dataset.meta.tasks, dataset.meta.episodes = meta.stats, meta.tasks, meta.episodes
    _check_positions(dataset, sorted(episodes), reason)
    if config.expert_action:
        frames = dataset.hf_dataset.remove_columns(ACTION)
        dataset.reader.hf_dataset = frames.rename_column(EXPERT_ACTION, ACTION)
    return dataset


def _check_positions(dataset: Any, episodes: Sequence[int], reason: str) -> None:
    """Check that LeRobot's dataset finds the frames of a window: by their rows in the files, or by their numbers."""
    first, end = (np.asarray(dataset.meta.episodes[f"dataset_{one}_index"])[episodes] for one in ("from", "to"))
    wanted = np.concatenate([np.arange(*span) for span in zip(first, end, strict=True)])
    index = dataset.hf_dataset.data.column("index").to_numpy()
    if dataset.episodes is None:  # by their rows
        is_right = np.array_equal(wanted, np.arange(len(wanted))) and np.array_equal(index[: len(wanted)], wanted)
    else:
        is_right = np.array_equal(np.sort(index), wanted)
    if not is_right:
        root = dataset.meta.root
        raise DatasetError(
            f"{root} has to be read by LeRobot's own loader, because {reason}; and that one takes row i of the data "
            "files for frame i, which it is not here: it would serve frames of other episodes. Run `bhd-data check "
            f"--fix {quoted(root)}`, or raise budget_gib."
        )


def _ending_before(dataset: Any, left_out: Tensor, config: LoaderConfig, reason: str) -> Any:
    """Return a dataset whose windows end before the samples that are left out: what was done there is not learned."""
    if isinstance(dataset, TableDataset):
        return dataset.ending_before(left_out)
    for key, times in (config.delta_timestamps or {}).items():
        if max(times) > 0:
            raise ConfigError(
                f"A weight of frames is 0, and {key!r} is learned in chunks, which are not to reach into the frames "
                f"that are left out; LeRobot's own loader, which is needed because {reason}, cannot end them there. "
                "Raise budget_gib, or set a small weight in place of 0."
            )
    return dataset


def _first_frames(index: Tensor, meta: Any, drop_n_last_frames: int) -> Tensor:
    """Return the samples that a batch may contain, in the order of the episodes, shape (M,), int64.

    Args:
        index: number of each sample's frame in the whole dataset, shape (N,).
    """
    ends = torch.as_tensor(meta.episodes["dataset_to_index"], dtype=torch.int64)
    end = ends[torch.searchsorted(ends, index, right=True)]
    samples = (index + drop_n_last_frames < end).nonzero()[:, 0]
    if not len(samples):
        raise ConfigError(f"drop_n_last_frames={drop_n_last_frames} leaves no frame: all episodes are shorter.")
    return samples[torch.argsort(index[samples], stable=True)]


def _per_task(task_index: Tensor, limit: int) -> Tensor:
    """Return at most about `limit` samples (0: all), the first of every task, as LeRobot does for `eval_steps`."""
    if limit == 0:
        return torch.arange(len(task_index))
    tasks = torch.unique(task_index).tolist()
    each = max(1, limit // len(tasks))
    return torch.cat([(task_index == task).nonzero()[:each, 0] for task in tasks])


def expert_stats(meta: Any) -> None:
    """Put the statistics of what the expert would have done in place of those of what was done."""
    if EXPERT_ACTION not in meta.features:
        raise DatasetError(
            f"{meta.root} has no column {EXPERT_ACTION!r}: the expert's actions were not recorded. Record it with "
            "--dataset.expert_action=true, or leave selection.expert_action false."
        )
    if meta.stats:
        meta.stats[ACTION] = meta.stats[EXPERT_ACTION]


def imagenet_stats(meta: Any) -> None:
    """Put the statistics of ImageNet's images in place of those of a dataset's cameras, as LeRobot's training does."""
    from lerobot.utils.constants import IMAGENET_STATS

    for key in meta.camera_keys if meta.stats else ():
        if key not in meta.depth_keys:
            for name, values in IMAGENET_STATS.items():
                meta.stats.setdefault(key, {})[name] = torch.tensor(values, dtype=torch.float32)
