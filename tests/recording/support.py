"""What the tests of the runs share."""

import io
import json
from pathlib import Path

import pyarrow.parquet as pq
from rich.console import Console

from bhd_lerobot.recording.config import RecordConfig
from bhd_lerobot.recording.record import main, record
from bhd_lerobot.recording.report import RecordResult
from bhd_lerobot.rollout.configuration import parse
from tests.forks import Fork
from tests.waiting import until


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


def start(root: Path, episodes: int, **overrides: object) -> Fork:
    """Record in a process of its own, and wait until so many episodes are saved or it has ended."""
    process = Fork(main, options(root, **overrides), output=root.with_name(f"{root.name}.log"))
    until(lambda: saved(root) >= episodes or process.poll() is not None, f"{episodes} episodes are saved")
    return process


def saved(root: Path) -> int:
    """Return how many episodes a dataset has; none if it is not there."""
    try:
        return int(json.loads((root / "meta" / "info.json").read_text())["total_episodes"])
    except (OSError, ValueError):
        return 0


def data_columns(root: Path) -> dict[str, list]:
    """Return all data columns of a dataset, in the order of its frames."""
    table = pq.read_table(root / "data")
    return {name: table[name].to_pylist() for name in table.column_names}


def episode_rows(root: Path) -> list[dict]:
    """Return the episodes' metadata, without where they are stored and without statistics."""
    rows = pq.read_table(root / "meta" / "episodes").to_pylist()
    return [{k: v for k, v in row.items() if k.startswith(("bhd/", "length", "tasks", "dataset_"))} for row in rows]
