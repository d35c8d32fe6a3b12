"""Arms that are files as robots: features, the contract, and tasks by rule, as of other arms."""

import re
from importlib import resources
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bhd_lerobot.errors import ConfigError
from bhd_lerobot.robots.arm import SO101, FileArm
from bhd_lerobot.robots.config_arm import FileArmConfig, GripperOptions, SO101Config
from bhd_lerobot.robots.conformance import check_robot
from tests.cases import each_case
from tests.recording.support import run_record

TEXT = resources.files("bhd_lerobot.bodies").joinpath("so101.xml").read_text(encoding="utf-8")
JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")


@pytest.fixture
def bare(tmp_path: Path) -> Path:
    """Return the file of an arm without a gripper."""
    text = re.sub(r'<body name="jaw".*?</body>', "", TEXT, flags=re.DOTALL)
    path = tmp_path / "bare.xml"
    path.write_text(text.replace('<position name="gripper" joint="gripper"/>', ""), encoding="utf-8")
    return path


def test_features_are_lerobots(bare: Path) -> None:
    for robot, names in (
        (SO101(SO101Config()), (*JOINTS, "gripper")),
        (FileArm(FileArmConfig(mjcf=bare)), JOINTS),
    ):
        assert tuple(robot.action_features) == tuple(f"{name}.pos" for name in names)
        assert tuple(robot.observation_features) == tuple(f"{name}.{end}" for end in ("pos", "vel") for name in names)


@pytest.mark.parametrize("kind", ["jaw", "none"])
def test_it_keeps_the_contract_of_a_robot(kind: str, bare: Path) -> None:
    check_robot(lambda: SO101(SO101Config()) if kind == "jaw" else FileArm(FileArmConfig(mjcf=bare)))


@each_case(
    ("task", "robot"),
    [*product(("reach", "pick"), ("so101", "ur3e")), ("pick", "ur5e"), ("pick", "ur10e"), ("reach", "arm")],
)
def test_tasks_are_solved_by_rule(task: str, robot: str, bare: Path, tmp_path: Path) -> None:
    names = {"robot__type": robot, "task__type": task, "brain__type": task}
    file = str(bare) if robot == "arm" else None
    usual = {"robot__beams": None, "dataset__episode_time_s": None}
    result, _ = run_record(tmp_path / "data", **names, **usual, robot__mjcf=file)
    assert (result.recorded, result.successes) == (3, 3)


@each_case(
    ("options", "message"),
    [
        ({}, "robot.mjcf is not set"),
        ({"mjcf": "/nowhere.xml"}, "there is no such file"),
        ({"mjcf": "bare", "ranges": {"elbow_flex": [1.0]}}, "needs the lowest and the highest"),
        ({"mjcf": "bare", "tool_offset": [0.0, np.nan, 0.0]}, "three finite numbers"),
        ({"mjcf": "bare", "gripper": GripperOptions(name="jaw")}, "robot.gripper.name"),
        ({"mjcf": "bare", "control": "impedance", "action_space": "tool"}, "has position servos"),
        ({"mjcf": "bare", "payload": 50.0}, "carries between 0 and"),
    ],
)
def test_bad_options_are_refused_by_name(options: dict[str, Any], message: str, bare: Path) -> None:
    given = {**options, "mjcf": bare} if options.get("mjcf") == "bare" else options
    with pytest.raises(ConfigError, match=message):
        FileArmConfig(**given).body()
