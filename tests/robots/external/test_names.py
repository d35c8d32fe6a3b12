"""A robot's names, and the policies that may drive it."""

from pathlib import Path

import pytest
from lerobot.robots.so_follower import SOFollowerRobotConfig

from bhd_lerobot.errors import ConfigError
from bhd_lerobot.policies.learned.brain import LearnedBrainConfig
from bhd_lerobot.policies.learned.contract import PolicyContract
from bhd_lerobot.registry import check_brain, robot_configs
from bhd_lerobot.robots.external.names import name_of_robot, names_of_robot


def test_ours_have_one_name() -> None:
    for kind, made in robot_configs().items():
        if made.__module__.startswith("bhd_lerobot."):
            assert {kind} == names_of_robot(made())


def test_a_policy_drives_the_robot_that_it_was_trained_on_by_any_of_its_names(tmp_path: Path) -> None:
    robot = SOFollowerRobotConfig(port="/dev/null")
    assert name_of_robot(robot) == "so_follower"
    (tmp_path / "config.json").write_text("{}")
    (tmp_path / "model.safetensors").touch()
    brain = LearnedBrainConfig(path=str(tmp_path))
    for name in ("so_follower", "so100_follower", "so101_follower"):
        PolicyContract(robot_type=name).save(tmp_path)
        check_brain("brain", brain, robot)
    for name in ("koch_follower", "turtlebot3"):
        PolicyContract(robot_type=name).save(tmp_path)
        with pytest.raises(ConfigError, match=f"{name}.*robot.type is"):
            check_brain("brain", brain, robot)
