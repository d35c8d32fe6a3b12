"""Which task belongs to a task's configuration."""

from collections.abc import Callable
from typing import Any

from bhd_lerobot.tasks.avoid import AvoidConfig, AvoidTask
from bhd_lerobot.tasks.navigate import NavigateConfig, NavigateTask
from bhd_lerobot.tasks.pick import PickConfig, PickTask
from bhd_lerobot.tasks.reach import ReachConfig, ReachTask
from bhd_lerobot.tasks.task import Task, TaskConfig

# Importing this module registers every configuration that it names.
TASKS: dict[type, Callable[[Any, int, int], Task]] = {
    AvoidConfig: AvoidTask,
    NavigateConfig: NavigateTask,
    PickConfig: PickTask,
    ReachConfig: ReachTask,
}
"""The tasks, by their configurations."""


def robot_of_task(config: TaskConfig) -> str:
    """Return the type of the robot that a task is for."""
    task: Any = TASKS[type(config)]
    return str(task.robot_type)


def make_task(config: TaskConfig, n: int, fps: int) -> Task:
    """Return the task that a configuration describes, for n simulations at `fps` frames a second."""
    return TASKS[type(config)](config, n, fps)
