"""What `bhd-train` says at its beginning and its end."""

import io
import shlex
from dataclasses import asdict, dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from lerobot.configs import PreTrainedConfig
from rich.console import Console

from bhd_lerobot.datasets.loader.batches import BatchLoader
from bhd_lerobot.datasets.loader.order import BatchOrder
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.evaluation.config import EvalConfig
from bhd_lerobot.options.parse import parse
from bhd_lerobot.policies.learned.contract import PolicyContract
from bhd_lerobot.policies.mlp.configuration_mlp import MlpConfig
from bhd_lerobot.policies.perception.configuration_perception import PerceptionConfig
from bhd_lerobot.recording.config import RecordConfig
from bhd_lerobot.registry import check_task
from bhd_lerobot.robots.config_turtlebot3 import TurtleBot3Config
from bhd_lerobot.robots.config_ur import UR5Config
from bhd_lerobot.robots.host.host import describe
from bhd_lerobot.tasks.avoid import AvoidConfig
from bhd_lerobot.tasks.pick import PickConfig
from bhd_lerobot.tasks.reach import ReachConfig
from bhd_lerobot.tasks.task import TaskConfig
from bhd_lerobot.tasks.variation import RandomisationConfig
from bhd_lerobot.training.data import TrainingData
from bhd_lerobot.training.summary import how_to_evaluate, print_start


def test_epochs_count_the_samples_of_all_processes() -> None:
    order = BatchOrder(torch.arange(100), 5, 0, world_size=4)
    data = TrainingData(BatchLoader(None, order), None, 100, 2, [], "in memory", "")
    policy: Any = SimpleNamespace(parameters=list, config=MlpConfig(device="cpu"))
    config: Any = SimpleNamespace(steps=50, batch_size=5, output_dir="run")
    console = Console(file=io.StringIO(), width=200)
    print_start(console, config, policy, data, 0)
    assert "50 of 20 samples: 10.0 epochs" in console.file.getvalue()


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
        (TurtleBot3Config(jerk_limits=False, collision_monitor=True), AvoidConfig()),
    ],
)
def test_the_command_evaluates_with_the_robot_and_the_task_of_the_recordings(robot, task) -> None:
    parameters = {"type": TaskConfig.get_choice_name(type(task)), **asdict(task)}
    contract = PolicyContract(robot_type=robot.type, task=parameters, robot=describe(robot))
    said, command = how_to_evaluate(contract, "run/checkpoints/000100")
    assert said == "Evaluate it with:"
    program, *options = shlex.split(command)
    assert program == "bhd-eval"
    config = parse(EvalConfig, [*options, "--brain.type=learned"])  # which is what a path alone means to bhd-eval
    assert describe(config.robot) == describe(robot)
    assert config.task == task
    (brain,) = config.brains.values()
    assert brain.path == "run/checkpoints/000100/pretrained_model"


def test_options_at_their_defaults_are_not_repeated() -> None:
    contract = PolicyContract(robot_type="ur5", task={"type": "pick"}, robot=describe(UR5Config(tool_pose=True)))
    assert how_to_evaluate(contract, "c")[1] == (
        "  bhd-eval --robot.type=ur5 --robot.tool_pose=true --task.type=pick --brain.path=c/pretrained_model"
    )


def test_a_robot_of_another_package_is_driven_by_its_own_options() -> None:
    said, command = how_to_evaluate(PolicyContract(robot_type="so101_follower"), "c")
    assert "the robot's own options" in said
    assert command == (
        "  bhd-record --robot.type=so101_follower --brain.type=learned --brain.path=c/pretrained_model "
        "--task.instruction='…' --dataset.root=data/rollout"
    )


def test_a_task_of_a_plug_in_that_is_not_installed_is_named_with_its_options() -> None:
    contract = PolicyContract(robot_type="ur5", task={"type": "hover", "hold_s": 0.4})
    said, command = how_to_evaluate(contract, "c")
    assert "'hover' is of a plug-in that is not installed" in said
    assert command == (
        "  bhd-eval --task.discover_packages_path=MODULE --robot.type=ur5 --task.type=hover --task.hold_s=0.4 "
        "--brain.path=c/pretrained_model"
    )


@dataclass
class WayConfig(AvoidConfig):
    """A task of this module, which no command finds by itself."""


def test_a_task_of_a_script_or_of_a_module_of_ones_own_is_found_by_the_module_that_is_named(monkeypatch) -> None:
    monkeypatch.setitem(TaskConfig._choice_registry, "way", WayConfig)
    contract = PolicyContract(robot_type="turtlebot3", task={"type": "way"})
    said, command = how_to_evaluate(contract, "c")
    assert f"where Python finds the module '{__name__}'" in said
    assert f" --task.discover_packages_path={__name__} " in command
    monkeypatch.setattr(WayConfig, "__module__", "__main__")
    said, command = how_to_evaluate(contract, "c")
    assert "'way' is defined in this script" in said
    assert " --task.discover_packages_path=MODULE " in command
    with pytest.raises(ConfigError, match=r"Unknown task.type 'where'.*--task.discover_packages_path=MODULE"):
        parse(EvalConfig, ["--robot.type=turtlebot3", "--task.type=where", "--brain.type=noop"])


@pytest.mark.parametrize("recipe", sorted(Path("configs/record").glob("*.yaml")), ids=lambda path: path.stem)
def test_the_command_after_every_recipe_evaluates_whole_episodes_of_its_task(recipe: Path) -> None:
    config = parse(RecordConfig, [f"--config_path={recipe}"])
    task = {"type": TaskConfig.get_choice_name(type(config.task)), **asdict(config.task)}
    contract = PolicyContract(robot_type=config.robot.type, task=task, robot=describe(config.robot))
    policy = PerceptionConfig() if config.brain.get_choice_name(type(config.brain)) == "noop" else MlpConfig()
    _, command = how_to_evaluate(contract, "c", policy)
    brain = ["--brain.type=learned"] if isinstance(policy, MlpConfig) else []
    evaluation = parse(EvalConfig, [*shlex.split(command)[1:], *brain])
    assert describe(evaluation.robot) == describe(config.robot)
    assert evaluation.task.duration_s >= 1.0


@pytest.mark.parametrize("robot", [TurtleBot3Config(), UR5Config()])
def test_of_a_simulated_robot_without_a_task_one_of_its_tasks_is_an_example(robot) -> None:
    said, command = how_to_evaluate(PolicyContract(robot_type=robot.type), "c")
    assert "does not record its task" in said
    config = parse(EvalConfig, [*shlex.split(command)[1:], "--brain.type=learned"])
    check_task(config.task, robot)


def test_the_command_names_the_module_of_a_policy_that_nothing_else_imports() -> None:
    @PreTrainedConfig.register_subclass("own_policy")
    @dataclass
    class OwnConfig(MlpConfig):
        pass

    OwnConfig.__module__ = "my_policy.configuration_own"
    _, command = how_to_evaluate(PolicyContract(robot_type="turtlebot3"), "c", OwnConfig())
    assert "--brain.discover_packages_path=my_policy.configuration_own" in shlex.split(command)
    _, command = how_to_evaluate(PolicyContract(robot_type="turtlebot3"), "c", MlpConfig())
    assert "discover_packages_path" not in command
