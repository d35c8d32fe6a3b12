"""Rows of a table and its images as batches, with windows in time and their padding masks."""

from collections.abc import Collection, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from bhd_lerobot.data.frame_cache import FrameCache
from bhd_lerobot.data.schema import DEFAULT_FEATURES
from bhd_lerobot.data.table import FrameTable
from bhd_lerobot.errors import DatasetError, unknown_name

if TYPE_CHECKING:
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

Batch = dict[str, Any]
"""Key -> tensor of shape (B, ...), or list of B strings: what PyTorch's default collate makes of LeRobot's samples."""


class Gatherer:
    """What all subsets of a dataset share: how to gather rows, worked out once."""

    def __init__(self, table: FrameTable, frames: FrameCache, deltas: Mapping[str, tuple[int, ...]]) -> None:
        """Stack the columns.

        Args:
            table: the columns.
            frames: the decoded images.
            deltas: key -> window, in frames relative to the sample.
        """
        self._table, self._frames = table, frames
        self._windows: dict[tuple[int, ...], Tensor] = {d: torch.tensor(d, dtype=torch.int64) for d in deltas.values()}
        self._deltas = dict(deltas)
        self._pads = list(deltas)
        self._tasks = [str(task) for task in table.meta.tasks.index]
        # Columns with one number a frame, stacked by type, are gathered together: one call for a dozen keys.
        alone = [key for key, column in table.columns.items() if column.ndim == 1 and key not in deltas]
        self._stacks: list[tuple[list[str], Tensor]] = []
        for kind in (torch.float32, torch.int64, torch.bool):
            keys = [key for key in alone if table.columns[key].dtype == kind]
            if keys:
                self._stacks.append((keys, torch.stack([table.columns[key] for key in keys])))
        self._flat = {key: column.reshape(len(table), -1) for key, column in table.columns.items() if key not in alone}
        # LeRobot puts videos first, then the columns; language columns do not survive its collate.
        videos = [key for key in frames.keys if key not in table.pictures]
        self._order = [*videos, *(key for key in table.keys if key not in table.nested)]

    def gather(self, rows: Tensor, return_uint8: bool) -> Batch:
        """Return the batch of some rows of the table."""
        table, size = self._table, len(rows)
        found: Batch = dict.fromkeys(self._order)
        windows, pads = self._windowed(rows)
        for keys, stack in self._stacks:
            found.update(zip(keys, stack.index_select(1, rows).unbind(), strict=True))
        for key, flat in self._flat.items():
            shape = table.columns[key].shape[1:]
            if key in self._deltas:
                window = windows[self._deltas[key]]
                found[key] = flat.index_select(0, window.view(-1)).view(*window.shape, *shape)
            else:
                found[key] = flat.index_select(0, rows).view(size, *shape)
        for key in self._frames.keys:
            window = windows[self._deltas[key]] if key in self._deltas else rows[:, None]
            found[key] = self._frames.gather(key, window, key in self._deltas, return_uint8)
        if table.texts:
            where = rows.numpy()
            for key, texts in table.texts.items():
                found[key] = texts[where].tolist()
        for key in self._pads:
            found[f"{key}_is_pad"] = pads[self._deltas[key]].clone()
        found["task"] = [self._tasks[task] for task in found["task_index"].tolist()]
        return found

    def _windowed(self, rows: Tensor) -> tuple[dict[tuple[int, ...], Tensor], dict[tuple[int, ...], Tensor]]:
        """Return the rows of every window, clamped to the episode, and which of them were clamped; shape (B, n)."""
        windows, pads = {}, {}
        if self._windows:
            first = self._table.first.index_select(0, rows)[:, None]
            last = self._table.last.index_select(0, rows)[:, None]
            for name, delta in self._windows.items():
                asked = rows[:, None] + delta
                windows[name] = torch.clamp(asked, first, last)
                pads[name] = windows[name] != asked
        return windows, pads


def delta_indices(
    meta: "LeRobotDatasetMetadata",
    delta_timestamps: Mapping[str, Sequence[float]] | None,
    tolerance_s: float,
    keep: Collection[str] | None = None,
) -> dict[str, tuple[int, ...]]:
    """Return delta_timestamps in frames.

    Raises:
        DatasetError: a key that the dataset does not have or that is not kept, or a time between two frames.
    """
    result = {}
    for key, times in (delta_timestamps or {}).items():
        if key not in meta.features:
            raise DatasetError(f"delta_timestamps of {meta.root}: {unknown_name('feature', key, meta.features)}")
        if keep is not None and key not in keep and key not in DEFAULT_FEATURES:
            raise DatasetError(f"delta_timestamps names {key!r}, which is not among the features to keep: {keep}.")
        if meta.features[key]["dtype"] in ("string", "language"):
            kind = meta.features[key]["dtype"]
            raise DatasetError(
                f"delta_timestamps names {key!r}, a feature of dtype {kind}; only numbers and images work."
            )
        frames = np.asarray(list(times), dtype=np.float64) * meta.fps
        off = np.abs(frames - np.round(frames)) / meta.fps > tolerance_s
        if off.any() or not len(frames):
            wrong = [float(time) for time, is_off in zip(times, off, strict=True) if is_off][:3]
            raise DatasetError(
                f"delta_timestamps of {key!r} must be multiples of 1 / {meta.fps} s, at least one; got {wrong}."
            )
        result[key] = tuple(int(frame) for frame in np.round(frames))
    return result
