"""Whether a policy can learn from a dataset; asked before training, not found out during it."""

import difflib
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import torch

from bhd_lerobot.datasets.loader.table import FrameTable
from bhd_lerobot.errors import DatasetError


def check(
    dataset: Any,
    policy_features: Mapping[str, Any] | Collection[str],
    *,
    fps: float | None = None,
    names: Mapping[str, Sequence[str]] | None = None,
) -> None:
    """Check that a dataset has what a policy learns from, and that all of it is finite.

    Args:
        dataset: a `TableDataset` or `LeRobotDataset`.
        policy_features: the keys that the policy reads or predicts; a mapping gives LeRobot's `PolicyFeature`, or the
            shape, of each. Shapes of images are not compared.
        fps: frames per second that the policy was trained with, if it was.
        names: key -> names of its numbers, in order, that the policy was trained with.

    Raises:
        DatasetError: the dataset is empty, lacks a feature, has another shape, other names or another rate, or a value
            that is not finite; the message names what is there and what to do.
    """
    meta = dataset.meta
    if not dataset.num_frames:
        raise DatasetError(f"{meta.root} has no frame, so there is nothing to learn. Record some with bhd-record.")
    if fps is not None and fps != meta.fps:
        raise DatasetError(
            f"{meta.root} was recorded at {meta.fps} frames per second, the policy works at {fps:g}. Record with "
            f"dataset.fps={fps:g}, or train a new policy."
        )
    for key in policy_features:
        if key not in meta.features:
            near = difflib.get_close_matches(key, list(meta.features), n=1)
            hint = f" Did you mean {near[0]!r}?" if near else ""
            raise DatasetError(
                f"The policy needs the feature {key!r}, which {meta.root} does not have.{hint} It has: "
                f"{', '.join(meta.features)}. Record with it, or leave it out of the policy's features."
            )
        _check_shape(meta, key, policy_features[key] if isinstance(policy_features, Mapping) else None)
        _check_names(meta, key, (names or {}).get(key))
    _check_finite(dataset, policy_features)


def _check_shape(meta: Any, key: str, wanted: Any) -> None:
    shape = getattr(wanted, "shape", wanted)
    found = tuple(meta.features[key]["shape"])
    if shape is not None and key not in meta.camera_keys and tuple(shape) != found:
        raise DatasetError(
            f"Feature {key!r} of {meta.root} has shape {found}, the policy's has {tuple(shape)}. It is a dataset of "
            "another robot or task; use one that fits, or train a new policy."
        )


def _check_names(meta: Any, key: str, wanted: Sequence[str] | None) -> None:
    found = meta.features[key].get("names")
    if wanted is None or found is None or list(wanted) == list(found):
        return
    pairs = zip(list(wanted) + [None] * len(found), list(found) + [None] * len(wanted), strict=False)
    index, (ours, theirs) = next((i, pair) for i, pair in enumerate(pairs) if pair[0] != pair[1])
    raise DatasetError(
        f"Feature {key!r} of {meta.root} has {theirs!r} as number {index}, the policy has {ours!r} there. Names, units "
        "and order must be those that the policy was trained with."
    )


def _check_finite(dataset: Any, keys: Collection[str]) -> None:
    meta = dataset.meta
    table, rows = getattr(dataset, "table", None), None
    if isinstance(table, FrameTable):
        rows = dataset.rows
    else:
        table = FrameTable.open(meta, dataset.episodes, keys)
    for key in keys:
        column = table.columns.get(key)
        if column is None or not column.is_floating_point():
            continue
        values = column if rows is None else column[rows]
        finite = torch.isfinite(values.reshape(len(values), -1))
        if bool(finite.all()):
            continue
        sample, element = (int(i) for i in (~finite).nonzero()[0])
        row = sample if rows is None else int(rows[sample])
        names = meta.features[key].get("names")
        which = f" ({names[element]})" if isinstance(names, list) and len(names) == finite.shape[1] > 1 else ""
        value = float(values.reshape(len(values), -1)[sample, element])
        count = int((~finite.all(1)).sum())
        raise DatasetError(
            f"{meta.root}, {table.place(row)}: {key!r}{which} is {value}, and {count} frames have "
            "such values. Leave their episodes out with dataset.episodes, or record them again."
        )
