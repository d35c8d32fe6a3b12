"""Whether a policy can learn from a dataset, checked before training."""

import difflib
import hashlib
import json
from collections.abc import Callable, Collection, Iterator
from typing import Any

import numpy as np
import torch

from bhd_lerobot.datasets.format.features import ACTION, EXPERT_ACTION, names_of, numbered_names_of
from bhd_lerobot.datasets.loader.table import FrameTable
from bhd_lerobot.errors import DatasetError, quoted
from bhd_lerobot.stock import load_stats


def check(dataset: Any, keys: Collection[str]) -> None:
    """Check that a policy can learn from a dataset: its features are there, finite, and can be normalised."""
    meta = dataset.meta
    for key in keys:
        if key not in meta.features:
            near = difflib.get_close_matches(key, list(meta.features), n=1)
            hint = f" Did you mean {near[0]!r}?" if near else ""
            raise DatasetError(
                f"The policy needs the feature {key!r}, which {meta.root} does not have.{hint} It has: "
                f"{', '.join(meta.features)}. Record with it, or leave it out of the policy's features."
            )
    for key, values, place in _columns(dataset, keys):
        finite = torch.isfinite(values)
        if bool(finite.all()):
            _check_deviation(meta, key, values)
            continue
        sample, element = (int(i) for i in (~finite).nonzero()[0])
        raise DatasetError(
            f"{meta.root}, {place(sample)}: {key!r}{_which(meta, key, element)} is {float(values[sample, element])}, "
            f"and {int((~finite.all(1)).sum())} frames have such values. Leave their episodes out with "
            "dataset.episodes, or record them again."
        )


def beyond(dataset: Any, key: str, low: str, high: str) -> float:
    """Return the largest share of frames in which a number of a feature lies beyond two of its statistics, 0 to 1."""
    stats = (dataset.meta.stats or {}).get(key, {})
    if low not in stats or high not in stats:
        return 0.0
    least, most = (torch.as_tensor(stats[name]).reshape(-1) for name in (low, high))
    shares = [0.0]
    for _, values, _ in _columns(dataset, [key]):
        shares += ((values < least) | (values > most)).float().mean(0).tolist()
    return max(shares)


def constant(dataset: Any, key: str) -> list[str]:
    """Return the numbers of a feature that are the same in all frames, by name or place."""
    names = numbered_names_of(dataset.meta.features[key])
    found = [(values == values[0]).all(0) for _, values, _ in _columns(dataset, [key])]
    return [names[place] for one in found for place in one.nonzero()[:, 0].tolist()]


def fingerprint(dataset: Any, keys: Collection[str]) -> str:
    """Return a digest of what a dataset serves: numbers, episodes and instructions; of images, their statistics.

    It is the same for each loader, wherever the dataset lies and however its files are divided.
    """
    meta = dataset.meta
    code = hashlib.blake2b(digest_size=16)
    for key, values, _ in _columns(dataset, sorted(keys)):
        code.update(f"{key} {tuple(values.shape)}".encode() + values.contiguous().numpy().tobytes())
    episodes = range(meta.total_episodes) if dataset.episodes is None else dataset.episodes
    about = [[int(meta.episodes["length"][i]), list(meta.episodes["tasks"][i])] for i in episodes]
    stored = load_stats(meta.root) or {}  # not those of ImageNet
    images = {
        key: np.round(stored[key]["mean"], 6).ravel().tolist()
        for key in sorted(keys)
        if key in meta.camera_keys and key in stored
    }
    code.update(json.dumps([about, images]).encode())
    return code.hexdigest()


def _columns(dataset: Any, keys: Collection[str]) -> Iterator[tuple[str, torch.Tensor, Callable[[int], str]]]:
    """Yield the features that are real numbers: key, values of shape (N, d), and what names the place of a sample."""
    table, rows = getattr(dataset, "table", None), None
    if isinstance(table, FrameTable):
        rows = dataset.rows
    else:
        # Where the expert's action is served as `action`, it has no column of its own any more.
        is_of_expert = EXPERT_ACTION in dataset.meta.features and EXPERT_ACTION not in dataset.hf_dataset.column_names
        sources = {ACTION: EXPERT_ACTION} if is_of_expert else None
        table = FrameTable.open(dataset.meta, dataset.episodes, keys, sources)
    for key in keys:
        column = table.columns.get(key)
        if column is not None and column.is_floating_point():
            values = (column if rows is None else column[rows]).reshape(dataset.num_frames, -1)
            yield key, values, lambda sample: table.place(sample if rows is None else int(rows[sample]))


def _which(meta: Any, key: str, element: int) -> str:
    names = names_of(meta.features[key])
    return f" ({names[element]})" if len(names) > 1 else ""


def _check_deviation(meta: Any, key: str, values: torch.Tensor) -> None:
    stored = torch.as_tensor((meta.stats or {}).get(key, {}).get("std", ())).reshape(-1)
    if len(stored) != values.shape[1]:
        return
    low, high = values.aminmax(dim=0)
    for element in ((stored == 0) & (high > low)).nonzero()[:1, 0].tolist():
        name = f"{key!r}{_which(meta, key, element)}"
        raise DatasetError(
            f"{meta.root}: the standard deviation of {name} is stored as 0, and its values go from "
            f"{float(low[element]):.6g} to {float(high[element]):.6g}. A policy would divide by it. Run "
            f"`bhd-data check --fix {quoted(meta.root)}`, which computes the statistics again."
        )
