"""Which brain and which task belong to a configuration."""

from collections.abc import Callable
from typing import Any

from bhd_lerobot.policies.avoidance import AvoidanceBrain, AvoidanceConfig
from bhd_lerobot.policies.brain import Brain
from bhd_lerobot.policies.config_brain import BrainConfig
from bhd_lerobot.policies.gap_follower import GapFollowerBrain, GapFollowerConfig
from bhd_lerobot.tasks.avoid import AvoidConfig, AvoidTask
from bhd_lerobot.tasks.config_task import TaskConfig
from bhd_lerobot.tasks.task import Task

# Importing this module registers every configuration that it names.
_BRAINS: dict[type, Callable[[Any], Brain]] = {
    AvoidanceConfig: AvoidanceBrain,
    GapFollowerConfig: GapFollowerBrain,
}
_TASKS: dict[type, Callable[[Any, int, int], Task]] = {AvoidConfig: AvoidTask}


def make_brain(config: BrainConfig) -> Brain:
    """Return the brain that a configuration describes."""
    return _BRAINS[type(config)](config)


def make_task(config: TaskConfig, n: int, fps: int) -> Task:
    """Return the task that a configuration describes, for n simulations at `fps` frames a second."""
    return _TASKS[type(config)](config, n, fps)
