"""`make demo`: every command line of its script is valid as it stands, and in small they work one after the other."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset

import bhd_lerobot.plugin  # noqa: F401  registers the policies
from bhd_lerobot.bodies.turtlebot3 import turtlebot3_burger
from bhd_lerobot.cli import evaluate, record, replay, train
from bhd_lerobot.errors import RenderingError
from bhd_lerobot.evaluation.config import EvalConfig
from bhd_lerobot.options.parse import parse
from bhd_lerobot.policies.learned.contract import PolicyContract
from bhd_lerobot.recording.config import RecordConfig
from bhd_lerobot.sim.camera import Camera
from bhd_lerobot.sim.world import World
from bhd_lerobot.training.arguments import parse_train

ROOT = Path(__file__).resolve().parents[2]
PROGRAMS = {"record": record.main, "replay": replay.main, "train": train.main, "eval": evaluate.main}
SMALL = {"steps": 4, "log_freq": 1, "eval_steps": 1, "n_envs": 2, "n_episodes": 2, "dataset.num_episodes": 2}
SMALL |= {"task.duration_s": 2, "save_freq": 2, "videos": 0, "preview_video": "false"}
OWN = {
    "ur5_pick": {"dataset.num_episodes": 1, "n_envs": 1},
    "ur5_reach": {"task.duration_s": 6, "brains.early.path": "ur5_reach/train/checkpoints/000002"},
    "ur5_see": {"dataset.num_episodes": 12, "n_envs": 1, "n_episodes": 1, "steps": 2, "batch_size": 4}
    | {"task.duration_s": 0.04, "robot.camera_width": 96, "robot.camera_height": 72},
}
NETWORK = {"policy.channels": 4, "policy.hidden": 4, "policy.context": 4}
# Stands for a program: writes down what it was asked for, and makes what the script looks for.
STUB = """
import json, pathlib, sys
with open({log!r}, "a") as file:
    print(json.dumps(sys.argv), file=file)
for name in [one.partition("=")[2] for one in sys.argv if one.startswith("--output_dir=")]:
    pathlib.Path(name).mkdir(parents=True)
    for made in ("episode.mp4", "report.html"):
        pathlib.Path(name, made).touch()
"""


@pytest.fixture(scope="module")
def lines(tmp_path_factory: pytest.TempPathFactory) -> list[list[str]]:
    """Return the command lines of the script, programs without their prefix."""
    folder = tmp_path_factory.mktemp("demo")
    for name in PROGRAMS:
        stub = folder / f"bhd-{name}"
        stub.write_text(f"#!{sys.executable}\n{STUB.format(log=str(folder / 'log'))}")
        stub.chmod(0o755)
    path = f"{folder}:/usr/bin:/bin"
    command = [ROOT / "scripts/demo.sh", folder / "out put"]
    done = subprocess.run(command, env={"PATH": path}, capture_output=True, text=True, check=True)
    assert [line for line in done.stdout.splitlines() if line.endswith("report.html")] == sorted(
        map(str, folder.glob("out put/*/eval/report.html"))
    )
    again = subprocess.run(command, env={"PATH": path}, capture_output=True, text=True, check=False)
    assert (again.returncode, "not empty" in again.stderr) == (2, True)
    read = [json.loads(line) for line in (folder / "log").read_text().splitlines()]
    return [[Path(program).name.removeprefix("bhd-"), *options] for program, *options in read]


def test_the_command_lines_are_valid(lines: list[list[str]]) -> None:
    splits = set()
    for program, *options in lines:
        if program == "record":
            splits.add(parse(RecordConfig, options).split)
        elif program == "train":
            config = parse_train(options)
            assert not config.save_freq or config.steps % config.save_freq == 0
        elif program == "eval":
            rules = [text for text in options if not re.search(r"learned|early|\.path=", text)]
            assert parse(EvalConfig, rules).split not in splits


def small(options: list[str]) -> list[str]:
    """Return the options of a short run of the same kind."""
    name = next(one for one in (*OWN, "turtlebot3_avoid") if any(one in option for option in options))
    values = dict(option.removeprefix("--").split("=", 1) for option in options)
    values |= {key: str(value) for key, value in {**SMALL, **OWN.get(name, {})}.items() if key in values}
    if "bhd_perception" in values.values():
        values |= {key: str(value) for key, value in NETWORK.items()}
    if "robot.type" in values:
        values |= {"threads": "1"}
    if "dataset.num_episodes" in values:
        values |= {"preview_video": "false"}
    return [f"--{key}={value}" for key, value in values.items()]


def test_in_small_they_work(lines: list[list[str]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    try:
        Camera(World(turtlebot3_burger(), 1), 32, 24).close()
    except RenderingError:
        lines = [one for one in lines if not any("ur5_see" in option for option in one)]
    for program, *options in lines:
        assert PROGRAMS[program](small(options)) == 0, (program, options)
    for name, episodes in (("turtlebot3_avoid", 2), ("ur5_reach", 2), ("ur5_pick", 1)):
        dataset = LeRobotDataset(f"bhd/demo_{name}", root=tmp_path / name / "dataset", video_backend="pyav")
        assert dataset.num_episodes == episodes
    for name in ("turtlebot3_avoid", "ur5_reach"):
        assert PolicyContract.load(Path(name, "train/checkpoints/last/pretrained_model")).robot_type in name
        results = json.loads(Path(name, "eval/results.json").read_text())
        assert list(results["brains"])[:2] == ["rule", "learned"]
