"""Rows of a table and its images as batches, with windows in time and their padding masks."""

import copy
from collections.abc import Collection, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from bhd_lerobot.datasets.format.schema import DEFAULT_FEATURES
from bhd_lerobot.datasets.loader.frame_cache import FrameCache
from bhd_lerobot.datasets.loader.table import FrameTable
from bhd_lerobot.errors import DatasetError, unknown_name

if TYPE_CHECKING:
    from bhd_lerobot.stock import LeRobotDatasetMetadata

Batch = dict[str, Any]
"""Key -> tensor of shape (B, ...), or list of B strings: what PyTorch's default collate makes of LeRobot's samples."""


class Gatherer:
    """What all subsets of a dataset share: how to gather rows, worked out once."""

    def __init__(self, table: FrameTable, frames: FrameCache, deltas: Mapping[str, tuple[int, ...]]) -> None:
        self._table, self._frames = table, frames
        self._deltas = dict(deltas)
        self._windows = {window: np.asarray(window, dtype=np.int64) for window in deltas.values()}
        self._first, self._last = table.first.numpy(), table.last.numpy()
        self._tasks = [str(task) for task in table.meta.tasks.index]
        # Columns with one number a frame, stacked by type, are gathered together: one call for a dozen keys.
        alone = [key for key, column in table.columns.items() if column.ndim == 1 and key not in deltas]
        self._stacks: list[tuple[list[str], NDArray]] = []
        for kind in (torch.float32, torch.int64, torch.bool):
            keys = [key for key in alone if table.columns[key].dtype == kind]
            if keys:
                self._stacks.append((keys, torch.stack([table.columns[key] for key in keys]).numpy()))
        self._wide = {key: column.numpy() for key, column in table.columns.items() if key not in alone}
        # LeRobot puts videos first, then the columns; language columns do not survive its collate.
        videos = [key for key in frames.keys if key not in table.images]
        self._order = [*videos, *(key for key in table.keys if key not in table.nested)]

    def gather(self, rows: Tensor, return_uint8: bool) -> Batch:
        """Return the batch of rows of the table, shape (B,); videos are float32 in [0, 1] unless they stay 8-bit."""
        # numpy's `take` copies whole rows in this thread. torch's `index_select` shares a batch of images among
        # threads, which costs more than the copy, and several hundred times as much while other programs run.
        at = rows.numpy()
        found: Batch = dict.fromkeys(self._order)
        windows, pads = self._windowed(at)
        for keys, stack in self._stacks:
            found.update(zip(keys, torch.from_numpy(stack.take(at, axis=1)).unbind(), strict=True))
        for key, column in self._wide.items():
            found[key] = torch.from_numpy(
                column.take(windows[self._deltas[key]] if key in self._deltas else at, axis=0)
            )
        for key in self._frames.keys:
            window = windows[self._deltas[key]] if key in self._deltas else at
            found[key] = self._frames.gather(key, window, return_uint8)
        for key, texts in self._table.texts.items():
            found[key] = texts.take(at).tolist()
        for key, delta in self._deltas.items():
            found[f"{key}_is_pad"] = torch.from_numpy(pads[delta].copy())
        found["task"] = [self._tasks[task] for task in found["task_index"].tolist()]
        return found

    def ending_before(self, rows: Tensor) -> "Gatherer":
        """Return one whose windows end before some rows of the table, as they do where an episode ends."""
        stops = np.append(np.sort(rows.numpy()), len(self._last))
        one = copy.copy(self)
        one._last = np.minimum(self._last, stops[np.searchsorted(stops[:-1], np.arange(len(self._last)), "right")] - 1)
        return one

    def _windowed(self, rows: NDArray) -> tuple[dict[tuple[int, ...], NDArray], dict[tuple[int, ...], NDArray]]:
        """Return the rows of every window, clamped to the episode, and which of them were clamped; shape (B, n)."""
        windows, pads = {}, {}
        if self._windows:
            first, last = self._first.take(rows)[:, None], self._last.take(rows)[:, None]
            for name, delta in self._windows.items():
                wanted = rows[:, None] + delta
                windows[name] = np.minimum(np.maximum(wanted, first), last)
                pads[name] = windows[name] != wanted
        return windows, pads


def delta_indices(
    meta: "LeRobotDatasetMetadata",
    delta_timestamps: Mapping[str, Sequence[float]] | None,
    tolerance_s: float,
    keep: Collection[str] | None = None,
) -> dict[str, tuple[int, ...]]:
    """Return delta_timestamps in frames."""
    result = {}
    for key, times in (delta_timestamps or {}).items():
        if key not in meta.features:
            raise DatasetError(f"delta_timestamps of {meta.root}: {unknown_name('feature', key, meta.features)}")
        if keep is not None and key not in keep and key not in DEFAULT_FEATURES:
            raise DatasetError(f"delta_timestamps names {key!r}, which is not among the features to keep: {keep}.")
        if meta.features[key]["dtype"] in ("string", "language"):
            raise DatasetError(f"delta_timestamps names {key!r}, which is text; only numbers and images have a window.")
        frames = np.asarray(list(times), dtype=np.float64) * meta.fps
        off = np.abs(frames - np.round(frames)) / meta.fps > tolerance_s
        if off.any() or not len(frames):
            wrong = [float(time) for time, is_off in zip(times, off, strict=True) if is_off][:3]
            raise DatasetError(
                f"delta_timestamps of {key!r} must be multiples of 1 / {meta.fps} s, at least one; got {wrong}."
            )
        result[key] = tuple(int(frame) for frame in np.round(frames))
    return result
