"""What the tests of the runs share."""

import io
from pathlib import Path

import pyarrow.parquet as pq
from rich.console import Console

from bhd_lerobot.recording.config import RecordConfig
from bhd_lerobot.recording.record import record
from bhd_lerobot.recording.report import RecordResult
from bhd_lerobot.rollout.configuration import parse


def options(root: Path, **overrides: object) -> list[str]:
    """Return a short recording's command line; overrides are written with `__` for dots, None leaves an option out."""
    values: dict[str, object] = {
        "robot.type": "turtlebot3",
        "brain.type": "avoidance",
        "task.type": "avoid",
        "preview_video": "false",
        "dataset.repo_id": "test/avoid",
        "dataset.root": root,
        "output_dir": root.parent / f"{root.name}_run",
        "dataset.num_episodes": 3,
        "dataset.episode_time_s": 3,
        "robot.beams": 36,
        **{key.replace("__", "."): value for key, value in overrides.items()},
    }
    return [f"--{key}={value}" for key, value in values.items() if value is not None]


def run_record(root: Path, **overrides: object) -> tuple[RecordResult, str]:
    """Record; return the result and what was printed."""
    console = Console(file=io.StringIO(), width=160)
    result = record(parse(RecordConfig, options(root, **overrides)), console)
    return result, console.file.getvalue()


def data_columns(root: Path) -> dict[str, list]:
    """Return all data columns of a dataset, in the order of its frames."""
    table = pq.read_table(root / "data")
    return {name: table[name].to_pylist() for name in table.column_names}


def episode_rows(root: Path) -> list[dict]:
    """Return the episodes' metadata, without where they are stored and without statistics."""
    rows = pq.read_table(root / "meta" / "episodes").to_pylist()
    return [{k: v for k, v in row.items() if k.startswith(("bhd/", "length", "tasks", "dataset_"))} for row in rows]
