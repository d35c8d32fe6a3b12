"""What a training run learns from, by its configuration; `data/` chooses, splits, checks and serves it."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from lerobot.configs import FeatureType, NormalizationMode, PreTrainedConfig

from bhd_lerobot.datasets.format.identity import default_root
from bhd_lerobot.datasets.format.state import load_info
from bhd_lerobot.datasets.loader.check import beyond, constant, fingerprint
from bhd_lerobot.datasets.loader.loader import Loader, check, expert_stats, imagenet_stats, make_loader
from bhd_lerobot.datasets.loader.source import local_metadata
from bhd_lerobot.datasets.loader.table import checked_episodes
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.errors import DatasetError, brief, quoted
from bhd_lerobot.stock import ImageTransforms, LeRobotDatasetMetadata, resolve_delta_timestamps
from bhd_lerobot.training.config import BhdTrainConfig


@dataclass
class TrainingData:
    """What is learned from: samples in an epoch, how batches are served as text, a digest of the data."""

    train: Loader
    held_out: Loader | None
    frames: int
    episodes: int
    held_out_episodes: list[int]
    how: str
    fingerprint: str


def open_metadata(config: BhdTrainConfig) -> LeRobotDatasetMetadata:
    """Return the metadata of the dataset that is learned from, with ImageNet's statistics if those are wanted."""
    dataset = config.dataset
    root = Path(dataset.root).expanduser() if dataset.root else None
    _refuse_empty(root or default_root(dataset.repo_id))
    chosen = config.selection

    def select(found: LeRobotDatasetMetadata) -> list[int]:
        return chosen.filter.select(found, dataset.episodes)

    meta = local_metadata(
        dataset.repo_id, root, dataset.revision, dataset.episodes, None if chosen.is_everything else select
    )
    checked_episodes(meta, dataset.episodes)
    if not meta.stats:
        raise DatasetError(
            f"{meta.root} has no statistics, so nothing can be normalised: it was not finalised. "
            f"Run bhd-data repair {quoted(meta.root)}."
        )
    if dataset.use_imagenet_stats:
        imagenet_stats(meta)
    if config.selection.expert_action:
        expert_stats(meta)
    return meta


def select_episodes(config: BhdTrainConfig, meta: LeRobotDatasetMetadata) -> None:
    """Put the episodes that `selection` leaves into `dataset.episodes`, so that lerobot-train can resume the run."""
    if not config.selection.is_everything:
        config.dataset.episodes = config.selection.filter.select(meta, config.dataset.episodes)


def _refuse_empty(root: Path) -> None:
    """Say so, because LeRobot cannot open the metadata of a dataset without episodes."""
    if (root / layout.INFO).is_file() and load_info(root)["total_episodes"] == 0:
        raise DatasetError(f"{root} has no episode, so there is nothing to learn from. Record some with bhd-record.")


def open_data(
    config: BhdTrainConfig,
    policy: PreTrainedConfig,
    meta: LeRobotDatasetMetadata,
    *,
    device: torch.device,
    rank: int = 0,
    world_size: int = 1,
    report: Callable[[str], None] = lambda message: None,
    by_own_statistics: bool = True,
) -> TrainingData:
    """Load the dataset.

    `device`: where batches are needed. `report`: gets the reason why LeRobot's own loader is used, if it is, and
    warnings. `by_own_statistics`: whether the policy is normalised by the statistics of this dataset.
    """
    dataset = config.dataset
    keep = kept_features(meta, policy, config.rename_map)
    resolved = resolve_delta_timestamps(policy, meta, config.rename_map)
    deltas = {key: times for key, times in resolved.items() if key in keep}
    for key, frames in getattr(policy, "own_delta_indices", {}).items():
        deltas |= {
            own: [frame / meta.fps for frame in frames] for own in deltas if config.rename_map.get(own, own) == key
        }
    loading = config.loader_config(
        delta_timestamps=deltas or None,
        drop_n_last_frames=getattr(policy, "drop_n_last_frames", 0),
        image_transforms=ImageTransforms(dataset.image_transforms) if dataset.image_transforms.enable else None,
        keep=keep,
        device=device,
        rank=rank,
        world_size=world_size,
    )
    loaders = make_loader(dataset.repo_id, loading, meta=meta, report=report)
    check(loaders.dataset, keep)
    if loaders.held_out is not None:
        check(loaders.held_out.dataset, keep)
    for key in keep if by_own_statistics else ():
        if warning := _beyond_quantiles(loaders.dataset, policy, key, config.rename_map.get(key, key)):
            report(warning)
        if warning := _of_constants(loaders.dataset, policy, key, config.rename_map.get(key, key)):
            report(warning)
    size = getattr(loaders.dataset, "nbytes", None)
    return TrainingData(
        train=loaders.train,
        held_out=loaders.held_out,
        frames=len(loaders.train.order.samples),
        episodes=loaders.dataset.num_episodes,
        held_out_episodes=[] if loaders.held_out is None else sorted(loaders.held_out.dataset.episodes),
        fingerprint=fingerprint(loaders.dataset, keep),
        how=f"LeRobot's, {config.num_workers} workers" if size is None else f"in memory, {size / 2**20:.3g} MiB",
    )


_QUANTILES = {
    NormalizationMode.QUANTILES: ("q01", "q99", 0.02),
    NormalizationMode.QUANTILE10: ("q10", "q90", 0.2),
}
"""By the way of normalising: what becomes -1 and 1, and the share of frames beyond."""


def _beyond_quantiles(dataset: Any, policy: PreTrainedConfig, key: str, name: str) -> str:
    """Return a warning if quantiles that a policy is normalised with are not those of the data."""
    features = {**(policy.input_features or {}), **(policy.output_features or {})}
    kind = features[name].type.value if name in features else ""
    mode = policy.normalization_mapping.get(kind)
    if mode not in _QUANTILES:
        return ""
    low, high, expected = _QUANTILES[mode]
    share = beyond(dataset, key, low, high)
    if share <= 2 * expected:
        return ""
    return (
        f"warning: {key} is normalised by {low} and {high}, and up to {100 * share:.0f} % of the frames lie beyond "
        f"them, not {100 * expected:.0f} %: LeRobot takes the average of the episodes' quantiles. Set {kind} of "
        "policy.normalization_mapping to MEAN_STD or MIN_MAX."
    )


_OWN_SCALE = (None, NormalizationMode.IDENTITY)


def _of_constants(dataset: Any, policy: PreTrainedConfig, key: str, name: str) -> str:
    """Return a warning if an input never changes in the data, and any other value would count as a huge one."""
    feature = (policy.input_features or {}).get(name)
    vectors = (FeatureType.STATE, FeatureType.ENV)
    if feature is None or feature.type not in vectors or hasattr(policy, "min_std"):
        return ""  # ours give such an input no influence
    if policy.normalization_mapping.get(feature.type.value) in _OWN_SCALE or not (names := constant(dataset, key)):
        return ""
    return (
        f"warning: {brief(names, _SHOWN)} of {key} never changes in the data. A {policy.type!r} divides by "
        "how much it changes: where the robot is off by a little there, its actions mean nothing. Record data in which "
        "it changes, or without it."
    )


_SHOWN = 6


def kept_features(
    meta: LeRobotDatasetMetadata, policy: PreTrainedConfig, rename_map: dict[str, str] | None = None
) -> list[str]:
    """Return the features of the dataset that the policy learns from, by the dataset's names."""
    wanted: set[Any] = {*(policy.input_features or {}), *(policy.output_features or {})}
    if policy.reward_delta_indices is not None:
        wanted |= {"next.reward", "next.done"}
    return [key for key in meta.features if (rename_map or {}).get(key, key) in wanted]
