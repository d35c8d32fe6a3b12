"""Small datasets and command lines for the tests of training."""

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from rich.console import Console

from bhd_lerobot.datasets.writer.recorder import DatasetRecorder
from bhd_lerobot.training.arguments import parse_train
from bhd_lerobot.training.log import TIMING
from bhd_lerobot.training.train import TrainResult, train
from tests.recording.support import command_line

FPS = 10
NAMES = ["a.pos", "b.pos", "c.pos", "a.vel"]
OUTCOMES = ("success", "timeout", "success", "collision", "success", "success")


def features(environment: bool = True, camera: bool = False) -> dict[str, dict[str, Any]]:
    result: dict[str, dict[str, Any]] = {
        "observation.state": {"dtype": "float32", "shape": (4,), "names": NAMES},
        "action": {"dtype": "float32", "shape": (2,), "names": ["a.pos", "b.pos"]},
        "event": {"dtype": "int64", "shape": (1,), "names": None},
    }
    if environment:
        result["observation.environment_state"] = {"dtype": "float32", "shape": (2,), "names": ["goal_x", "goal_y"]}
    if camera:
        names = ["height", "width", "channels"]
        result["observation.images.front"] = {"dtype": "video", "shape": (32, 32, 3), "names": names}
    return result


def make_dataset(
    root: Path,
    *,
    episodes: int = 6,
    frames: int = 20,
    environment: bool = True,
    camera: bool = False,
    fps: int = FPS,
    robot: str = "toy",
    shift: float = 0.0,
    spread: float = 0.0,
    instructions: int = 1,
) -> Path:
    """Record episodes in which the action follows from what is observed; return the dataset's folder."""
    described = features(environment, camera)
    recording = {"task": {"type": "toy"}}
    with DatasetRecorder.create("t/t", fps, described, robot_type=robot, root=root, recording=recording) as recorder:
        for episode in range(episodes):
            rng = np.random.default_rng(episode)
            state = rng.normal(size=(frames, 4)).astype(np.float32).cumsum(0) / 4
            goal = np.repeat(rng.normal(size=(1, 2)), frames, 0).astype(np.float32)
            event = np.zeros(frames, dtype=np.int64)
            event[:3] = 5
            columns = {
                "observation.state": state,
                "action": (np.tanh(goal - state[:, :2]) + shift + spread * episode).astype(np.float32),
                "event": event,
            }
            if environment:
                columns["observation.environment_state"] = goal
            writer = recorder.begin_episode()
            writer.set_columns(columns)
            if camera:
                for frame in range(frames):
                    writer.add_image("observation.images.front", np.full((32, 32, 3), 10 * episode + frame, np.uint8))
            outcome = OUTCOMES[episode % len(OUTCOMES)]
            metadata = {"outcome": outcome, "score": episode / 10}
            recorder.save(writer, task=f"go {episode % instructions}", metadata=metadata)
        recorder.finalize()
    return root


def poison(root: Path, key: str, row: int, value: float) -> None:
    """Overwrite a number in the first data file of a dataset."""
    path = next((root / "data").glob("*/*.parquet"))
    table = pq.read_table(path)
    rows = table[key].to_pylist()
    rows[row][0] = value
    place = table.schema.get_field_index(key)
    pq.write_table(
        table.set_column(place, table.schema.field(place), pa.array(rows, table.schema.field(place).type)), path
    )


ACT = {
    "policy.type": "act",
    "policy.chunk_size": 5,
    "policy.n_action_steps": 5,
    "policy.dim_model": 16,
    "policy.n_heads": 2,
    "policy.dim_feedforward": 16,
    "policy.n_encoder_layers": 1,
    "policy.n_vae_encoder_layers": 1,
    "policy.latent_dim": 4,
    "policy.optimizer_lr": 1e-3,
}
MLP = {"policy.type": "bhd_mlp", "policy.hidden_dims": [16, 16], "policy.chunk_size": 4}


def options(root: Path, run: Path | None, policy: dict[str, Any] | None = None, **overrides: Any) -> list[str]:
    """Return a short training's command line."""
    values = {
        "dataset.repo_id": "t/t",
        "dataset.root": root,
        "output_dir": run,
        "policy.device": "cpu",
        "batch_size": 8,
        "steps": 20,
        "log_freq": 5,
        "save_freq": 10,
        "num_workers": 0,
        "threads": 1,
        "env_eval_freq": 0,
        **(ACT if policy is None else policy),
    }
    return command_line(values, overrides)


def run_train(arguments: list[str]) -> tuple[TrainResult, str]:
    """Train; return the result and what was printed."""
    console = Console(file=io.StringIO(), width=200)
    result = train(parse_train(arguments), console)
    return result, console.file.getvalue()


def curve(run: Path) -> list[dict[str, Any]]:
    """Return what a run measured, without times."""
    rows = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    return [{key: value for key, value in row.items() if key not in TIMING} for row in rows]
