"""Frames per second of recording: LeRobot's own writer, this package, and pyarrow alone, on the same frames.

Run with ``python -m benchmarks.recording``. All of them record the same episodes in one process, in turns; the table
shows medians. Both datasets are read back through stock LeRobot and compared value by value.
"""

import contextlib
import gc
import io
import logging
import shutil
import sys
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from benchmarks._report import Report, parse_options
from benchmarks._turns import in_turns, seconds
from bhd_lerobot.datasets.format.schema import Schema
from bhd_lerobot.datasets.writer.recorder import DatasetRecorder

FPS = 10
STATE = 362
METADATA = {"seed": 1, "outcome": "success", "score": 0.5, "brain": "avoidance"}


def features() -> dict[str, dict[str, Any]]:
    """Return the features of a recording of a TurtleBot3 with all its beams."""

    def feature(dtype: str, size: int = 1) -> dict[str, Any]:
        return {"dtype": dtype, "shape": (size,), "names": None}

    result = {"observation.state": feature("float32", STATE), "action": feature("float32", 2)}
    result |= {f"control.{name}": feature("float32") for name in ("time", "age", "lateness", "overruns", "limited")}
    result |= {"control.watchdog": feature("bool"), "control.mode": feature("int64"), "event": feature("int64")}
    result |= {"next.reward": feature("float32"), "next.success": feature("bool"), "next.done": feature("bool")}
    return result


def episodes(count: int, length: int) -> list[dict[str, np.ndarray]]:
    """Return the columns of seeded episodes: a drifting lidar scan with noise, and a few flags."""
    rng = np.random.default_rng(0)
    result = []
    for _ in range(count):
        scan = 1.5 + np.cumsum(rng.normal(0, 0.02, (length, STATE)), axis=0) + rng.normal(0, 0.01, (length, STATE))
        columns = {"observation.state": np.clip(scan, 0.12, 3.5).astype(np.float32)}
        columns["action"] = rng.uniform(-0.2, 0.2, (length, 2)).astype(np.float32)
        for key, feature in features().items():
            if key not in columns:
                values = rng.normal(size=length) if feature["dtype"] == "float32" else rng.random(length) < 0.1
                columns[key] = values.astype(feature["dtype"])
        result.append(columns)
    return result


def record_with_lerobot(root: Path, data: list) -> None:
    """Record with LeRobot's own writer."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    dataset = LeRobotDataset.create("bench/lerobot", FPS, features(), root=root, robot_type="bench")
    for columns in data:
        for i in range(len(columns["action"])):
            frame = {key: values[i] if values.ndim == 2 else values[i : i + 1] for key, values in columns.items()}
            dataset.add_frame({**frame, "task": "avoid"})
        dataset.save_episode()
    dataset.finalize()


def record_with_ours(root: Path, data: list, *, by_frame: bool) -> None:
    """Record with this package, by frames or by columns."""
    with DatasetRecorder.create("bench/ours", FPS, features(), robot_type="bench", root=root, recording={}) as recorder:
        for columns in data:
            episode = recorder.begin_episode()
            if not by_frame:
                episode.set_columns(columns)
            for i in range(len(columns["action"])) if by_frame else ():
                episode.add_frame({key: values[i] for key, values in columns.items()})
            recorder.save(episode, task="avoid", metadata=METADATA)


def write_with_pyarrow(root: Path, data: list, options: dict[str, Any]) -> None:
    """Write the same columns with one ``pq.write_table`` per episode, and nothing else."""
    schema = Schema(features())
    root.mkdir()
    start = 0
    for index, columns in enumerate(data):
        frames = np.arange(len(columns["action"]))
        full = {**columns, "timestamp": (frames / FPS).astype(np.float32), "frame_index": frames}
        full |= {"episode_index": np.full(len(frames), index), "index": frames + start, "task_index": frames * 0}
        pq.write_table(schema.table(full), root / f"{index}.parquet", **options)
        start += len(frames)


def check(root: Path, data: list) -> None:
    """Read a dataset with stock LeRobot and compare every value with what was recorded."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    dataset = LeRobotDataset("bench/check", root=root, video_backend="pyav")
    table = dataset.hf_dataset.with_format("arrow")[:]
    assert len(dataset) == sum(len(columns["action"]) for columns in data)
    for key in data[0]:
        column = table[key].combine_chunks()
        values = column.flatten() if pa.types.is_fixed_size_list(column.type) else column
        wanted = np.concatenate([columns[key] for columns in data])
        assert np.array_equal(values.to_numpy(zero_copy_only=False).reshape(wanted.shape), wanted), key
    assert dataset[0]["observation.state"].numpy().tobytes() == data[0]["observation.state"][0].tobytes()
    assert set(dataset.meta.stats["observation.state"]) >= {"min", "max", "mean", "std", "count", "q01", "q99"}


def main() -> int:
    """Run all of them in turns and print the table."""
    arguments = parse_options(__doc__, episodes=20, length=300, repeats=5)
    data = episodes(arguments.episodes, arguments.length)
    logging.disable(logging.WARNING)
    contestants: dict[str, Callable[[Path], None]] = {
        "ours, set_columns": partial(record_with_ours, data=data, by_frame=False),
        "ours, add_frame": partial(record_with_ours, data=data, by_frame=True),
        "LeRobot add_frame + save_episode + finalize": partial(record_with_lerobot, data=data),
        "pyarrow alone, write_table as it comes": partial(write_with_pyarrow, data=data, options={}),
        "pyarrow alone, without dictionaries": partial(
            write_with_pyarrow, data=data, options={"use_dictionary": False}
        ),
    }
    done = set()

    def run(name: str) -> float:
        folder = Path(tempfile.mkdtemp(prefix="bhd-bench-"))
        try:
            gc.collect()
            # LeRobot shows a progress bar per episode; into memory, so that the terminal costs it no time.
            with contextlib.redirect_stderr(io.StringIO()), contextlib.redirect_stdout(io.StringIO()):
                took = seconds(lambda: contestants[name](folder / "dataset"))
                if name not in done and "pyarrow" not in name:
                    check(folder / "dataset", data)
            done.add(name)
            return took
        finally:
            shutil.rmtree(folder)

    times = in_turns({name: partial(run, name) for name in contestants}, arguments.repeats)
    frames = arguments.episodes * arguments.length
    speeds = {name: [frames / one for one in took] for name, took in times.items()}
    report = Report(f"{arguments.episodes} episodes of {arguments.length} frames, {STATE} floats")
    report.compare("recording", "frames/s", speeds, [name for name in speeds if "ours" not in name], form=",.0f")
    return report.end(arguments.json)


if __name__ == "__main__":
    sys.exit(main())
