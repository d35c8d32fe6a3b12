"""The help of the programs: every option with a meaning, short until a type is chosen."""

import re

import lerobot.policies  # noqa: F401  registers LeRobot's policies
import pytest

from bhd_lerobot.errors import ConfigError
from bhd_lerobot.evaluation.config import EvalConfig
from bhd_lerobot.options.help import help_of
from bhd_lerobot.options.parse import parse
from bhd_lerobot.options.plugins import load_lerobot
from bhd_lerobot.recording.config import RecordConfig
from bhd_lerobot.rollout.replay.config import ReplayConfig
from bhd_lerobot.ros2.serve.config import BridgeConfig, ServeConfig
from bhd_lerobot.training.config import BhdTrainConfig
from bhd_lerobot.training.rl.config import RlConfig

PROGRAMS = (RecordConfig, ReplayConfig, EvalConfig, BhdTrainConfig, RlConfig)


@pytest.fixture(autouse=True)
def wide(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "120")


@pytest.mark.parametrize("program", PROGRAMS)
def test_it_is_short_until_a_type_is_chosen(program: type) -> None:
    lines = help_of(program, {}).splitlines()
    assert len(lines) <= 200
    assert max(map(len, lines)) <= 120


def test_a_chosen_type_lists_its_options_with_units_and_defaults() -> None:
    text = " ".join(help_of(RecordConfig, {"robot.type": "turtlebot3", "brain.type": "gap_follower"}).split())
    assert "robot.type=turtlebot3: " in text
    assert "--robot.beams=N" in text
    assert "[m]" in text
    assert "(at least 0 and finite; default: 0.05)" in text
    assert "Its options: --task.type=TYPE --help" in text
    assert "--robot.beams" not in help_of(RecordConfig, {})
    assert "--policy.chunk_size=N" in help_of(BhdTrainConfig, {"policy.type": "act"})


@pytest.mark.parametrize("program", [ServeConfig, BridgeConfig])
def test_types_that_a_program_refuses_are_not_listed(program: type) -> None:
    taken = "Valid: arm, so101, turtlebot3, ur10e, ur3e, ur5, ur5e. "
    assert f"{taken}Its options" in " ".join(help_of(program, {}).split())
    with pytest.raises(ConfigError, match=f"Did you mean 'turtlebot3'. {taken}"):
        parse(program, ["--robot.type=turtelbot3"])


def test_brains_by_name() -> None:
    assert "--brains.NAME.type=TYPE" in help_of(EvalConfig, {})
    assert "--brains.mine.margin_m=X" in help_of(EvalConfig, {"brains.mine.type": "gap_follower"})


def test_a_type_that_is_not_there_is_left_to_the_parser() -> None:
    assert help_of(RecordConfig, {"robot.type": "nobody"}) == help_of(RecordConfig, {})


def test_lerobots_robots_and_teleoperators_are_listed_with_their_options() -> None:
    from lerobot.robots.config import RobotConfig

    text = help_of(RecordConfig, {})
    load_lerobot("lerobot.robots")
    robots, _, rest = text.partition("--task.type")
    assert set(RobotConfig.get_known_choices()) - set(re.findall(r"\w+", robots)) <= {"mock_arm"}
    assert "so101_leader" in rest
    assert "--robot.port=TEXT" in help_of(RecordConfig, {"robot.type": "so101_follower"})
