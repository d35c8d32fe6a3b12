"""What the tests of the runs share."""

import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from rich.console import Console

from bhd_lerobot.cli.record import main
from bhd_lerobot.options.parse import parse
from bhd_lerobot.policies.learned.contract import PolicyContract
from bhd_lerobot.policies.mlp.configuration_mlp import MlpConfig
from bhd_lerobot.recording.config import RecordConfig
from bhd_lerobot.recording.record import record
from bhd_lerobot.recording.report import RecordResult
from tests.forks import Fork
from tests.waiting import until


def command_line(values: Mapping[str, object], overrides: Mapping[str, object]) -> list[str]:
    """Return a command line; overrides are written with `__` for dots, and None leaves an option out."""
    values = {**values, **{key.replace("__", "."): value for key, value in overrides.items()}}
    return [f"--{key}={value}" for key, value in values.items() if value is not None]


def options(root: Path, **overrides: object) -> list[str]:
    """Return a short recording's command line."""
    values = {
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
    }
    return command_line(values, overrides)


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


STATE = ("x.vel", "theta.vel", *(f"scan_{beam:03d}.pos" for beam in range(36)))
ACTIONS = ("x.vel", "theta.vel")


def save_mlp(folder: Path, seed: int, state: int, action: list[float], spread: list[float], **options: Any) -> Path:
    """Save an untrained policy, as a training saves it, whose actions are some numbers and their spread."""
    inputs = {"observation.state": PolicyFeature(FeatureType.STATE, (state,))}
    outputs = {"action": PolicyFeature(FeatureType.ACTION, (len(action),))}
    chunk = {"hidden_dims": [16], "chunk_size": 4, "n_action_steps": 2}
    config: Any = MlpConfig(device="cpu", input_features=inputs, output_features=outputs, **chunk, **options)
    torch.manual_seed(seed)
    policy = get_policy_class(config.type)(config)
    stats = {
        "observation.state": {"mean": np.zeros(state), "std": np.ones(state)},
        "action": {"mean": np.array(action), "std": np.array(spread)},
    }
    for values in stats.values():
        values |= {"min": values["mean"] - values["std"], "max": values["mean"] + values["std"]}
    for one in (policy, *make_pre_post_processors(config, dataset_stats=stats)):
        one.save_pretrained(folder)
    return folder


def save_lidar_policy(folder: Path) -> Path:
    """Save an untrained policy for the robot of these options; return the folder."""
    save_mlp(folder, 0, len(STATE), [0.1, 0.1], [0.3, 0.3])
    PolicyContract(
        robot_type="turtlebot3", fps=10, observation_names=STATE, action_names=ACTIONS, environment_names=(), cameras={}
    ).save(folder)
    return folder
