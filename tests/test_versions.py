"""Packages that others replaced by versions that are not supported: one sentence, and no harm to LeRobot's commands."""

import os
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import pytest

from bhd_lerobot.errors import VersionError
from bhd_lerobot.versions import check_version, required_versions
from tests.cases import each_case

ROOT = Path(__file__).resolve().parents[1]


def other(version: str | None):
    def version_of(name: str) -> str:
        if version is None:
            raise metadata.PackageNotFoundError(name)
        return version

    return version_of


@each_case("name", ["mujoco", "pin", "lerobot"])
def test_the_sentence_names_the_version_the_valid_ones_and_how_to_get_one(name: str) -> None:
    check_version(name)
    for version, found in (("0.0.1", f"{name} is 0.0.1; "), (None, f"{name} is not installed; ")):
        with pytest.raises(VersionError) as raised:
            check_version(name, other(version))
        text = str(raised.value)
        assert text.startswith(found)
        assert f"{'needs' if version is None else 'supports'} {name}{required_versions()[name]}" in text
        assert f"pip install '{name}{required_versions()[name]}'" in text
        assert not isinstance(raised.value, ImportError)  # LeRobot passes over those, and looks elsewhere


COMMANDS = """
import sys
from bhd_lerobot.cli import start
for line in sys.argv[1:]:
    name, *options = line.split()
    sys.argv = [f"bhd-{name}", *(options or ["--help"])]
    try:
        status = getattr(start, name)()
    except SystemExit as end:
        status = end.code
    print("ended:", name, status)
"""

STOCK = """
import logging
from lerobot.robots.config import RobotConfig
from lerobot.robots.utils import make_robot_from_config
from lerobot.teleoperators.config import TeleoperatorConfig
from lerobot.envs.configs import EnvConfig
from lerobot.utils.import_utils import register_third_party_plugins
import lerobot.robots.so_follower

register_third_party_plugins()
print(sorted(RobotConfig.get_known_choices()), sorted(TeleoperatorConfig.get_known_choices()))
robot = RobotConfig.get_choice_class("turtlebot3")(beams=36)
for make in (lambda: make_robot_from_config(robot), lambda: EnvConfig.get_choice_class("bhd")()):
    try:
        make()
    except Exception as error:
        print("sentence", error)
"""


def run_beside(folder: Path, name: str, version: str, program: str, *arguments: str) -> subprocess.CompletedProcess:
    """Run a program where a package is installed in another version, whose import fails."""
    (folder / f"{name}-{version}.dist-info").mkdir()
    (folder / f"{name}-{version}.dist-info" / "METADATA").write_text(
        f"Metadata-Version: 2.4\nName: {name}\nVersion: {version}\n"
    )
    if name == "mujoco":
        (folder / "mujoco.py").write_text("raise AttributeError('no attribute mjSTATE_PLASTIC')")
    return subprocess.run(
        [sys.executable, "-c", program, *arguments],
        env={**os.environ, "PYTHONPATH": f"{folder}{os.pathsep}{ROOT}"},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.mark.thorough
def test_every_command_that_simulates_ends_in_one_sentence_beside_another_mujoco(tmp_path: Path) -> None:
    avoid = "--robot.type=turtlebot3 --task.type=avoid --brain.type=avoidance"
    record, evaluate = f"record {avoid} --dataset.root={tmp_path}/d", f"evaluate {avoid} --output_dir={tmp_path}/e"
    replay = f"replay --dataset.root={tmp_path}/d"
    done = run_beside(tmp_path, "mujoco", "3.8.1", COMMANDS, record, "train", evaluate, replay, "data", "monitor")
    assert "Traceback" not in done.stderr
    refused = [line for line in done.stderr.splitlines() if line]
    assert len(refused) == 3  # a training looks at data alone, unless it evaluates
    assert all(line.startswith("error: mujoco is 3.8.1; ") for line in refused)
    statuses = [line for line in done.stdout.splitlines() if line.startswith("ended:")]
    assert statuses == [
        "ended: record 2",
        "ended: train 0",
        "ended: evaluate 2",
        "ended: replay 2",
        "ended: data 0",
        "ended: monitor 0",
    ]


def test_every_command_but_two_ends_in_one_sentence_beside_another_lerobot(tmp_path: Path) -> None:
    commands = ("record", "train", "evaluate", "replay", "data", "monitor")
    done = run_beside(tmp_path, "lerobot", "0.9.0", COMMANDS, *commands)
    refused = [line for line in done.stderr.splitlines() if line]
    assert len(refused) == 5
    assert all(line.startswith("error: lerobot is 0.9.0; ") for line in refused)
    assert done.stdout.count(" 2\n") == 5
    assert "ended: monitor 0" in done.stdout


def test_lerobots_commands_keep_their_robots_and_ours_say_what_is_wrong(tmp_path: Path) -> None:
    done = run_beside(tmp_path, "mujoco", "3.8.1", STOCK)
    assert "Could not import" not in done.stderr
    choices, *sentences = done.stdout.splitlines()
    for name in ("so101_follower", "turtlebot3", "ur5", "bhd_brain"):
        assert f"'{name}'" in choices
    assert len(sentences) == 2
    assert all("mujoco is 3.8.1; lerobot_robot_bhd supports mujoco>=" in one for one in sentences)


@pytest.mark.thorough
def test_lerobots_commands_go_on_beside_our_refusal_of_their_version(tmp_path: Path) -> None:
    program = STOCK.partition("robot =")[0]
    done = run_beside(tmp_path, "lerobot", "0.9.0", program)
    assert done.returncode == 0
    assert "'so101_follower'" in done.stdout
    assert "lerobot is 0.9.0; lerobot_robot_bhd supports lerobot" in done.stderr


WITHOUT_RUCKIG = """
import sys
from importlib import metadata
sys.modules["ruckig"] = None  # an import of it fails
from bhd_lerobot import versions
from bhd_lerobot.control.motion import trajectory

def absent(name):
    raise metadata.PackageNotFoundError(name)

trajectory.check_version = lambda name: versions.check_version(name, absent)
from bhd_lerobot.errors import VersionError
from bhd_lerobot.registry import make_simulation
from bhd_lerobot.robots.config_turtlebot3 import TurtleBot3Config
from bhd_lerobot.robots.config_ur import UR5Config
from bhd_lerobot.robots.turtlebot3 import TurtleBot3

with TurtleBot3(TurtleBot3Config(arena="empty")) as robot:
    print("base", robot.send_action({"x.vel": 0.1, "theta.vel": 0.0}))
try:
    make_simulation(UR5Config())
except VersionError as error:
    print(error)
"""


@pytest.mark.thorough
def test_only_arms_need_ruckig_and_say_how_to_get_it() -> None:
    program = [sys.executable, "-c", WITHOUT_RUCKIG]
    done = subprocess.run(program, capture_output=True, text=True, check=True, cwd=ROOT)
    base, arm = done.stdout.splitlines()
    assert base.startswith("base {'x.vel': ")
    assert arm.startswith("Arms need Ruckig. ruckig is not installed; lerobot_robot_bhd needs ruckig: pip install")
    assert arm.endswith("apt-get install g++ cmake")
