"""What a training run learns from: episodes chosen and split, checked, and served as batches."""

import math
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.factory import resolve_delta_timestamps
from lerobot.transforms import ImageTransforms
from lerobot.utils.constants import IMAGENET_STATS
from torch import Tensor

from bhd_lerobot.data.features import EVENT
from bhd_lerobot.data.frame_cache import MemoryBudgetError, UnsupportedDatasetError
from bhd_lerobot.data.identity import default_root
from bhd_lerobot.data.loader import BatchLoader, TableDataset, first_frames
from bhd_lerobot.data.order import BatchOrder
from bhd_lerobot.data.source import local_metadata
from bhd_lerobot.data.table import FrameTable, checked_episodes
from bhd_lerobot.errors import ConfigError, DatasetError
from bhd_lerobot.runs.config_train import BhdTrainConfig, SelectionConfig
from bhd_lerobot.runs.train_stock_loader import StockLoader, open_stock
from bhd_lerobot.tasks.task import Event

Batch = dict[str, Any]


class BatchSource(Protocol):
    """Batches of an epoch, again and again, from where a state says."""

    def __iter__(self) -> Iterator[Batch]: ...

    def state_dict(self) -> dict[str, Any]:
        """Return where it is, after the last batch that was handed out, as JSON values."""
        ...

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from there."""
        ...


@dataclass
class TrainingData:
    """What is learned from.

    Attributes:
        train: batches to learn from.
        held_out: makes an iterator over all batches of the held-out episodes; None if there are none.
        frames: samples in an epoch.
        episodes: numbers of the episodes that are learned from.
        held_out_episodes: numbers of those that are not.
        how: how the batches are served, in words.
    """

    train: BatchSource
    held_out: Callable[[], Iterator[Batch]] | None
    frames: int
    episodes: list[int]
    held_out_episodes: list[int]
    how: str


def open_metadata(config: BhdTrainConfig) -> LeRobotDatasetMetadata:
    """Return the metadata of the dataset that is learned from, with ImageNet's statistics if those are wanted.

    Raises:
        DatasetError: there is no such dataset, it is empty, or it has no statistics.
    """
    dataset = config.dataset
    root = Path(dataset.root).expanduser() if dataset.root else None
    _refuse_empty(root or default_root(dataset.repo_id))
    meta = local_metadata(dataset.repo_id, root, dataset.revision)
    checked_episodes(meta, None)
    if not meta.stats:
        raise DatasetError(
            f"{meta.root} has no statistics, so nothing can be normalised: it was not finalised. "
            f"Run bhd-data repair {meta.root}."
        )
    if dataset.use_imagenet_stats:
        for key in meta.camera_keys:
            for kind, values in IMAGENET_STATS.items():
                meta.stats[key][kind] = torch.tensor(values, dtype=torch.float32)
    return meta


def _refuse_empty(root: Path) -> None:
    """LeRobot's metadata of a dataset without episodes cannot be made."""
    import json

    try:
        info = json.loads((root / "meta" / "info.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return  # whoever opens it says so
    if isinstance(info, dict) and info.get("total_episodes") == 0:
        raise DatasetError(f"{root} has no episode, so there is nothing to learn from. Record some with bhd-record.")


def choose_episodes(
    meta: LeRobotDatasetMetadata, selection: SelectionConfig, episodes: Sequence[int] | None
) -> list[int]:
    """Return the numbers of the episodes that are wanted.

    Args:
        meta: of the dataset.
        selection: which outcomes are wanted.
        episodes: to choose from; all if None.

    Raises:
        DatasetError: an episode that does not exist; no episode is left, or the dataset does not say how they ended.
    """
    wanted = checked_episodes(meta, episodes)
    if selection.is_everything:
        return wanted
    columns = {}
    for key, is_needed in (
        ("bhd/outcome", selection.outcomes is not None),
        ("bhd/score", selection.min_score is not None),
    ):
        if is_needed:
            if key not in meta.episodes.column_names:
                raise DatasetError(
                    f"{meta.root} does not say how its episodes ended (no {key} in meta/episodes): bhd-record did not "
                    "record it. Set --selection.outcome=all without min_score, and choose with dataset.episodes."
                )
            columns[key] = meta.episodes[key]
    chosen = [
        one
        for one in wanted
        if (selection.outcomes is None or columns["bhd/outcome"][one] in selection.outcomes)
        and (selection.min_score is None or columns["bhd/score"][one] >= selection.min_score)
    ]
    if not chosen:
        asked = [] if selection.outcomes is None else [f"outcome {' or '.join(selection.outcomes)}"]
        asked += [] if selection.min_score is None else [f"a score of at least {selection.min_score}"]
        there = []
        if "bhd/outcome" in columns:
            counts = Counter(columns["bhd/outcome"][one] for one in wanted)
            there.append(", ".join(f"{count} x {name}" for name, count in counts.most_common()))
        if "bhd/score" in columns:
            there.append(f"scores up to {max(columns['bhd/score'][one] for one in wanted):.3g}")
        raise DatasetError(
            f"No episode of {meta.root} is left: of {len(wanted)}, none has {' and '.join(asked)}. "
            f"There are {'; '.join(there)}. Loosen --selection, or record more."
        )
    return chosen


def split_episodes(meta: LeRobotDatasetMetadata, episodes: Sequence[int], share: float) -> tuple[list[int], list[int]]:
    """Return episodes to learn from and held-out ones: the last of each task, as LeRobot splits.

    Args:
        meta: of the dataset.
        episodes: to split.
        share: how many are held out, 0 to 1.

    Raises:
        ConfigError: none is left to learn from.
    """
    if share == 0.0:
        return list(episodes), []
    tasks = meta.episodes["tasks"]
    by_task: dict[str, list[int]] = {}
    for one in episodes:
        by_task.setdefault(tasks[one][0] if tasks[one] else "", []).append(one)
    train, held_out = [], []
    for group in by_task.values():
        count = len(group) - math.ceil(len(group) * share)
        train += group[:count]
        held_out += group[count:]
    if not train:
        raise ConfigError(
            f"dataset.eval_split is {share}, which leaves no episode to learn from: of each of {len(by_task)} tasks "
            f"at least one episode is held out, and there are {len(episodes)} episodes. Record more, or set it to 0."
        )
    return train, held_out


def open_data(
    config: BhdTrainConfig,
    policy: PreTrainedConfig,
    meta: LeRobotDatasetMetadata,
    *,
    device: torch.device,
    rank: int = 0,
    world_size: int = 1,
) -> TrainingData:
    """Load the dataset.

    Args:
        config: what is asked for.
        policy: the policy's configuration, with its features.
        meta: of the dataset.
        device: where batches are needed.
        rank: this process among `world_size`.
        world_size: processes that train together.

    Raises:
        BhdError: no episode is left, a value is not finite, or the dataset cannot be read.
    """
    episodes = choose_episodes(meta, config.selection, config.dataset.episodes)
    train, held_out = split_episodes(meta, episodes, config.dataset.eval_split)
    keep = kept_features(meta, policy, config.rename_map)
    deltas = {
        key: times for key, times in (resolve_delta_timestamps(policy, meta) or {}).items() if key in keep
    } or None
    transforms = ImageTransforms(config.dataset.image_transforms) if config.dataset.image_transforms.enable else None
    drop = getattr(policy, "drop_n_last_frames", 0)
    seed = 0 if config.seed is None else config.seed
    deal: dict[str, Any] = {"rank": rank, "world_size": world_size}
    try:
        whole = TableDataset(
            meta.repo_id,
            root=meta.root,
            episodes=None if len(episodes) == meta.total_episodes else episodes,
            delta_timestamps=deltas,
            budget_gib=config.budget_gib,
            image_transforms=transforms,
            tolerance_s=config.tolerance_s,
            video_backend=config.dataset.video_backend,
            keep=[*keep, *([EVENT] if EVENT in meta.features else [])],
            return_uint8=True,
        )
    except (MemoryBudgetError, UnsupportedDatasetError) as error:
        table = FrameTable.open(meta, episodes, [key for key in keep if meta.features[key]["dtype"] != "video"])
        check_finite(table, keep)
        stock = open_stock(config, meta, train, deltas, transforms)
        weights = None
        if config.selection.intervention_weight != 1.0:
            weights = frame_weights(FrameTable.open(meta, train, [EVENT]), config.selection)
        return TrainingData(
            train=StockLoader.for_training(stock, config, seed, drop, weights, device=device, **deal),
            held_out=_stock_held_out(config, meta, held_out, deltas, device=device, deal=deal),
            frames=len(stock),
            episodes=train,
            held_out_episodes=held_out,
            how=f"LeRobot's loader, {config.num_workers} workers, because: {error}",
        )
    check_finite(whole.table, keep)
    dataset = whole.subset(train) if held_out else whole
    weights = None
    if config.selection.intervention_weight != 1.0:
        weights = frame_weights(whole.table, config.selection)[dataset.rows]
    loader = BatchLoader(
        dataset,
        config.batch_size,
        seed,
        weights=weights,
        device=device,
        pin=device.type == "cuda",
        drop_n_last_frames=drop,
        **deal,
    )
    evaluation = None
    if held_out:
        rest = whole.subset(held_out)
        rest.set_image_transforms(None)
        samples = held_out_samples(rest.table.columns["task_index"][rest.rows], config.max_eval_samples)
        evaluation = _batches(rest, samples, config.batch_size, device, **deal)
    return TrainingData(
        train=loader,
        held_out=evaluation,
        frames=len(first_frames(dataset, drop)),
        episodes=train,
        held_out_episodes=held_out,
        how=f"in memory, {whole.nbytes / 2**20:.3g} MiB",
    )


def kept_features(
    meta: LeRobotDatasetMetadata, policy: PreTrainedConfig, rename_map: dict[str, str] | None = None
) -> list[str]:
    """Return the features of the dataset that the policy learns from, by the dataset's names."""
    wanted = {*(policy.input_features or {}), *(policy.output_features or {})}
    if policy.reward_delta_indices is not None:
        wanted |= {"next.reward", "next.done"}
    return [key for key in meta.features if (rename_map or {}).get(key, key) in wanted]


def check_finite(table: FrameTable, keys: Sequence[str]) -> None:
    """Refuse values that a network would turn into nothing but NaN.

    Raises:
        DatasetError: names the first such value: episode, frame and key.
    """
    for key in keys:
        column = table.columns.get(key)
        if column is None or not column.is_floating_point() or bool(torch.isfinite(column).all()):
            continue
        bad = ~torch.isfinite(column.reshape(len(column), -1))
        row = int(bad.any(1).nonzero()[0, 0])
        place = int(bad[row].nonzero()[0, 0])
        names = table.meta.features[key].get("names")
        name = f" ({names[place]})" if isinstance(names, list) and len(names) == bad.shape[1] else ""
        value = float(column.reshape(len(column), -1)[row, place])
        raise DatasetError(
            f"{table.meta.root}: {key}[{place}]{name} is {value} in {table.place(row)}; "
            f"{int(bad.any(1).sum())} frames have such values of {key}. Leave those episodes out with "
            "--dataset.episodes, or record them again."
        )


def frame_weights(table: FrameTable, selection: SelectionConfig) -> Tensor:
    """Return how often each frame is drawn, compared with others, shape (N,).

    Raises:
        DatasetError: the dataset does not say where somebody intervened, or nothing is left.
    """
    if EVENT not in table.columns:
        raise DatasetError(
            f"{table.meta.root} does not say where somebody intervened (no column {EVENT!r}). "
            "Set --selection.intervention_weight=1."
        )
    intervened = table.columns[EVENT] == int(Event.INTERVENTION)
    weights = torch.where(intervened, float(selection.intervention_weight), 1.0)
    if not bool((weights > 0).any()):
        raise DatasetError(
            f"No frame of {table.meta.root} is left: somebody intervened in all of the {len(weights)} chosen ones, and "
            "selection.intervention_weight is 0."
        )
    return weights


def held_out_samples(tasks: Tensor, at_most: int) -> Tensor:
    """Return the samples that the held-out loss is computed of: all, or the first few of each task, as in LeRobot.

    Args:
        tasks: number of each sample's task, shape (N,).
        at_most: how many samples together; all if 0.
    """
    if at_most <= 0:
        return torch.arange(len(tasks))
    kinds = sorted(set(tasks.tolist()))
    each = max(1, at_most // len(kinds))
    return torch.cat([(tasks == kind).nonzero()[:each, 0] for kind in kinds])


def _batches(
    dataset: TableDataset, samples: Tensor, batch_size: int, device: torch.device, *, rank: int, world_size: int
) -> Callable[[], Iterator[Batch]]:
    def iterate() -> Iterator[Batch]:
        for indices in samples.split(batch_size)[rank::world_size]:
            batch = dataset.batch(indices)
            yield {key: one.to(device) if isinstance(one, Tensor) else one for key, one in batch.items()}

    return iterate


def _stock_held_out(
    config: BhdTrainConfig,
    meta: LeRobotDatasetMetadata,
    episodes: list[int],
    deltas: dict[str, list[float]] | None,
    *,
    device: torch.device,
    deal: dict[str, int],
) -> Callable[[], Iterator[Batch]] | None:
    if not episodes:
        return None
    stock = open_stock(config, meta, episodes, deltas, None)
    tasks = FrameTable.open(meta, episodes, ["task_index"]).columns["task_index"]
    samples = held_out_samples(tasks, config.max_eval_samples)

    def iterate() -> Iterator[Batch]:
        order = BatchOrder(samples, config.batch_size, 0, shuffle=False, **deal)
        return iter(StockLoader(stock, order, config, device))

    return iterate
