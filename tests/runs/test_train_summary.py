"""What `bhd-train` says at its end."""

import shlex
from dataclasses import asdict

import pytest

from bhd_lerobot.policies.contract import PolicyContract
from bhd_lerobot.robots.config_turtlebot3 import TurtleBot3Config
from bhd_lerobot.robots.config_ur5 import UR5Config
from bhd_lerobot.robots.simulation import describe
from bhd_lerobot.runs.config_eval import EvalConfig
from bhd_lerobot.runs.configuration import parse
from bhd_lerobot.runs.train_summary import evaluate_command
from bhd_lerobot.tasks.avoid import AvoidConfig
from bhd_lerobot.tasks.config_task import TaskConfig
from bhd_lerobot.tasks.pick import PickConfig
from bhd_lerobot.tasks.reach import ReachConfig
from bhd_lerobot.tasks.variation import RandomisationConfig


@pytest.mark.parametrize(
    ("robot", "task"),
    [
        (UR5Config(action_space="tool", tool_pose=True, fps=50), PickConfig(max_objects=1)),
        (
            UR5Config(control="impedance", action_space="tool", stale_after_s=0.05),
            ReachConfig(hold_s=1.0, randomisation=RandomisationConfig(enabled=True, camera_error_m=[0.01, 0.0, 0.02])),
        ),
        (TurtleBot3Config(odometry=True, beams=36), AvoidConfig(trail=True, arena="empty")),
        (TurtleBot3Config(), AvoidConfig()),
    ],
)
def test_the_command_evaluates_with_the_robot_and_the_task_of_the_recordings(robot, task) -> None:
    parameters = {"type": TaskConfig.get_choice_name(type(task)), **asdict(task)}
    contract = PolicyContract(robot_type=robot.type, task=parameters, robot=describe(robot))
    program, *options = shlex.split(evaluate_command(contract, "run/checkpoints/000100"))
    assert program == "bhd-eval"
    config = parse(EvalConfig, [*options, "--brain.type=learned"])  # which is what a path alone means to bhd-eval
    assert describe(config.robot) == describe(robot)
    assert config.task == task
    (brain,) = config.brains.values()
    assert brain.path == "run/checkpoints/000100/pretrained_model"


def test_options_at_their_defaults_are_not_repeated() -> None:
    contract = PolicyContract(robot_type="ur5", task={"type": "pick"}, robot=describe(UR5Config(tool_pose=True)))
    assert evaluate_command(contract, "c") == (
        "bhd-eval --robot.type=ur5 --robot.tool_pose=true --task.type=pick --brain.path=c/pretrained_model"
    )


def test_a_robot_that_is_not_simulated_is_driven_by_lerobot() -> None:
    command = evaluate_command(PolicyContract(robot_type="so101_follower"), "c")
    assert command == "lerobot-rollout --robot.type=so101_follower --policy.path=c/pretrained_model"
