"""Brain, hand, data: simulated robots, a fixed-rate cerebellum and crash-safe datasets for LeRobot.

``import bhd_lerobot as bhd`` gives what a notebook needs; each name is imported when it is first used.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.1"

if TYPE_CHECKING:
    from bhd_lerobot.api import evaluate, make_brain, make_robot, make_task, record, replay, train
    from bhd_lerobot.bodies.arenas import Arena, make_arena, register_arena
    from bhd_lerobot.bodies.body import Arm, MobileBase, Shape
    from bhd_lerobot.bodies.differential_base import differential_base
    from bhd_lerobot.bodies.turtlebot3 import turtlebot3_burger
    from bhd_lerobot.bodies.ur5 import ur5
    from bhd_lerobot.control.commands import Chunk, Goals, Mixed
    from bhd_lerobot.datasets.edit.edits import delete, keep, merge
    from bhd_lerobot.datasets.format.summary import dataset_info
    from bhd_lerobot.datasets.loader.config import LoaderConfig
    from bhd_lerobot.datasets.loader.loader import make_loader
    from bhd_lerobot.datasets.recovery.repair import repair
    from bhd_lerobot.datasets.validate.dataset import check_dataset
    from bhd_lerobot.datasets.writer.recorder import DatasetRecorder
    from bhd_lerobot.envs.gym_env import BhdEnv
    from bhd_lerobot.envs.vector import BhdVectorEnv
    from bhd_lerobot.errors import BhdError
    from bhd_lerobot.evaluation.config import EvalConfig
    from bhd_lerobot.policies.brain import BrainConfig, ConfiguredBrain, Observation, RobotFeatures, find_scan
    from bhd_lerobot.recording.config import RecordConfig
    from bhd_lerobot.registry import register_brain, register_robot, register_task
    from bhd_lerobot.robots.base import SimulatedBase
    from bhd_lerobot.robots.config import MobileBaseConfig
    from bhd_lerobot.robots.conformance import check_robot
    from bhd_lerobot.rollout.replay import ReplayConfig
    from bhd_lerobot.tasks.task import BaseTask, Event, Outcome, TaskConfig
    from bhd_lerobot.training.config import BhdTrainConfig

_MODULES = {
    "api": "evaluate make_brain make_robot make_task record replay train",
    "bodies.arenas": "Arena make_arena register_arena",
    "bodies.body": "Arm MobileBase Shape",
    "bodies.differential_base": "differential_base",
    "bodies.turtlebot3": "turtlebot3_burger",
    "bodies.ur5": "ur5",
    "control.commands": "Chunk Goals Mixed",
    "datasets.edit.edits": "delete keep merge",
    "datasets.format.summary": "dataset_info",
    "datasets.loader.config": "LoaderConfig",
    "datasets.loader.loader": "make_loader",
    "datasets.recovery.repair": "repair",
    "datasets.validate.dataset": "check_dataset",
    "datasets.writer.recorder": "DatasetRecorder",
    "envs.gym_env": "BhdEnv",
    "envs.vector": "BhdVectorEnv",
    "errors": "BhdError",
    "evaluation.config": "EvalConfig",
    "policies.brain": "BrainConfig ConfiguredBrain Observation RobotFeatures find_scan",
    "recording.config": "RecordConfig",
    "registry": "register_brain register_robot register_task",
    "robots.base": "SimulatedBase",
    "robots.config": "MobileBaseConfig",
    "robots.conformance": "check_robot",
    "rollout.replay": "ReplayConfig",
    "tasks.task": "BaseTask Event Outcome TaskConfig",
    "training.config": "BhdTrainConfig",
}
_PLACES = {name: module for module, names in _MODULES.items() for name in names.split()}

__all__ = ["__version__", *_PLACES]


def __getattr__(name: str) -> Any:
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_PLACES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
