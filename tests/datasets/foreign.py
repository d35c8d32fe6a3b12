"""Datasets of another program in LeRobot's format, written with nothing but pyarrow, which a test then changes."""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from bhd_lerobot.datasets.format import statistics
from bhd_lerobot.datasets.validate.dataset import DatasetCheck, Finding, Severity, check_dataset

FPS = 10
LENGTHS = (5, 1, 7)
TASKS = ("lift the cup", "turn around", "wait")
FEATURES: dict[str, dict[str, Any]] = {
    "observation.state": {"dtype": "float32", "shape": [3], "names": None},
    "action": {"dtype": "float32", "shape": [1], "names": None},
    "timestamp": {"dtype": "float32", "shape": [1], "names": None},
    **{
        key: {"dtype": "int64", "shape": [1], "names": None}
        for key in ("frame_index", "episode_index", "index", "task_index")
    },
}
INFO = {
    "codebase_version": "v3.0",
    "fps": FPS,
    "robot_type": "toy",
    "features": FEATURES,
    "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
    "video_path": None,
    "splits": {},
}
Columns = dict[str, np.ndarray]


def action(episode: int, frame: int) -> float:
    """Return what identifies a frame."""
    return 100.0 * episode + frame


def columns(episode: int, length: int, start: int) -> Columns:
    """Return an episode's columns; its instruction is the one with its own number, counted around."""
    frame = np.arange(length)
    rng = np.random.default_rng(episode)
    return {
        "observation.state": rng.normal(size=(length, 3)).astype(np.float32),
        "action": np.array([action(episode, i) for i in frame], np.float32),
        "timestamp": (frame / FPS).astype(np.float32),
        "frame_index": frame,
        "episode_index": np.full(length, episode),
        "index": start + frame,
        "task_index": np.full(length, episode % len(TASKS)),
    }


def write(
    root: Path,
    lengths: Sequence[int] = LENGTHS,
    files: Sequence[int] | None = None,
    change: Callable[[int, Columns], object] = lambda episode, columns: None,
    stats_of: Callable[[Columns], dict[str, statistics.Stats]] = statistics.column_stats,
) -> Path:
    """Write a dataset.

    Args:
        root: its folder.
        lengths: frames of each episode.
        files: number of the data file of each episode; all in the first if None.
        change: changes an episode's columns, statistics following.
        stats_of: computes the statistics of an episode.
    """
    slots = [0] * len(lengths) if files is None else list(files)
    starts = np.cumsum([0, *lengths]).tolist()
    episodes = [columns(i, length, starts[i]) for i, length in enumerate(lengths)]
    for i, one in enumerate(episodes):
        change(i, one)
    for slot in set(slots):
        tables = [_table(one) for one, own in zip(episodes, slots, strict=True) if own == slot]
        _write(root / f"data/chunk-000/file-{slot:03d}.parquet", pa.concat_tables(tables))
    stats = [stats_of(one) for one in episodes]
    write_rows(root, starts, slots, stats)
    write_tasks(root, dict(enumerate(TASKS)))
    total = {
        key: statistics.aggregate({name: np.stack([one[key][name] for one in stats]) for name in stats[0][key]})
        for key in stats[0]
    }
    _dump(root / "meta/stats.json", {key: {n: v.tolist() for n, v in one.items()} for key, one in total.items()})
    counts = {"total_episodes": len(lengths), "total_frames": starts[-1], "total_tasks": len(TASKS)}
    _dump(root / "meta/info.json", {**INFO, **counts})
    return root


def in_single_precision(columns: Columns) -> dict[str, statistics.Stats]:
    """Return statistics with deviations as LeRobot computes them: the mean of the squares minus that of the values."""
    stats = statistics.column_stats(columns)
    for key, values in columns.items():
        if values.dtype == np.float32:
            variance = (values**2).mean(axis=0) - values.mean(axis=0) ** 2
            stats[key]["std"] = np.sqrt(np.maximum(variance, 0)).astype(np.float64).reshape(-1)
    return stats


def write_rows(
    root: Path, starts: Sequence[int], slots: Sequence[int], stats: Sequence[dict[str, statistics.Stats]]
) -> None:
    """Write ``meta/episodes``."""
    rows: dict[str, Any] = {
        "episode_index": list(range(len(slots))),
        "tasks": [[TASKS[i % len(TASKS)]] for i in range(len(slots))],
        "length": np.diff(starts).tolist(),
        "dataset_from_index": starts[:-1],
        "dataset_to_index": starts[1:],
        "data/chunk_index": [0] * len(slots),
        "data/file_index": slots,
        "meta/episodes/chunk_index": [0] * len(slots),
        "meta/episodes/file_index": [0] * len(slots),
    }
    for key, one in stats[0].items():
        for name in one:
            rows[f"stats/{key}/{name}"] = [own[key][name].tolist() for own in stats]
    _write(root / "meta/episodes/chunk-000/file-000.parquet", pa.table(rows))


def write_tasks(root: Path, tasks: dict[int, str]) -> None:
    """Write ``meta/tasks.parquet``, as pandas does: the instruction is the index."""
    import pandas as pd

    frame = pd.DataFrame({"task_index": list(tasks)}, index=pd.Index(list(tasks.values()), name="task"))
    frame.to_parquet(root / "meta/tasks.parquet")


def edit(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Change the columns of a Parquet file, given as lists."""
    table = pq.read_table(path)
    values = table.to_pydict()
    change(values)
    fields = [field for field in table.schema if field.name in values]
    pq.write_table(pa.table(values, schema=pa.schema(fields)), path)


def edit_json(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Change a JSON file."""
    values = json.loads(path.read_text())
    change(values)
    _dump(path, values)


def errors(root: Path) -> list[Finding]:
    """Return what a check finds to be an error."""
    return [one for one in check(root).findings if one.severity is Severity.ERROR]


def check(root: Path) -> DatasetCheck:
    """Check a dataset."""
    return check_dataset(root)


def _table(columns: Columns) -> pa.Table:
    arrays = {
        key: pa.FixedSizeListArray.from_arrays(pa.array(values.reshape(-1)), values.shape[1])
        if values.ndim == 2
        else pa.array(values)
        for key, values in columns.items()
    }
    return pa.table(arrays)


def _write(path: Path, table: pa.Table) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(table, path)


def _dump(path: Path, values: dict[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(values))
