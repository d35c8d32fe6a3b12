"""Every robot, task and brain of this package: its configuration, and what the configuration makes.

A new one is a line in a table here. Its name is that of `register_subclass` above its configuration; importing this
module registers all of them, with LeRobot, too.
"""

from collections.abc import Callable
from typing import Any

from lerobot.robots.config import RobotConfig

from bhd_lerobot.errors import ConfigError
from bhd_lerobot.policies.baselines import NoopBrain, NoopConfig, RandomBrain, RandomConfig
from bhd_lerobot.policies.brain import ANY_ROBOT, Brain, BrainConfig
from bhd_lerobot.policies.dagger.brain import DaggerBrain, DaggerConfig, robot_of_both
from bhd_lerobot.policies.language.language_brain import LanguageBrain, LanguageBrainConfig
from bhd_lerobot.policies.learned.brain import LearnedBrain, LearnedBrainConfig
from bhd_lerobot.policies.manipulation.pick import PickBrain, PickBrainConfig
from bhd_lerobot.policies.manipulation.reach import ReachBrain, ReachBrainConfig
from bhd_lerobot.policies.navigation.avoidance import AvoidanceBrain, AvoidanceConfig
from bhd_lerobot.policies.navigation.gap_follower import GapFollowerBrain, GapFollowerConfig
from bhd_lerobot.policies.navigation.navigator import NavigatorBrain, NavigatorConfig
from bhd_lerobot.robots.config_turtlebot3 import TurtleBot3Config
from bhd_lerobot.robots.config_ur5 import UR5Config
from bhd_lerobot.robots.host.realtime import make_live
from bhd_lerobot.robots.host.simulation import Simulation
from bhd_lerobot.robots.turtlebot3_simulation import TurtleBot3Simulation
from bhd_lerobot.robots.ur5_simulation import UR5Simulation
from bhd_lerobot.tasks.avoid import AvoidConfig, AvoidTask
from bhd_lerobot.tasks.navigate import NavigateConfig, NavigateTask
from bhd_lerobot.tasks.pick import PickConfig, PickTask
from bhd_lerobot.tasks.reach import ReachConfig, ReachTask
from bhd_lerobot.tasks.task import Task, TaskConfig


class _Dagger(DaggerBrain):
    """A `dagger` brain, made of two of the brains below."""

    def __init__(self, config: DaggerConfig) -> None:
        super().__init__(config, make_brain(config.learner), make_brain(config.expert))

    @staticmethod
    def robot_of(config: DaggerConfig) -> str:
        """Return the robot that both drive."""
        return robot_of_both(*(robot_of_brain(part) or ANY_ROBOT for part in (config.learner, config.expert)))


ROBOTS: dict[type[RobotConfig], Callable[[Any, int, int | None], Simulation]] = {
    TurtleBot3Config: TurtleBot3Simulation,
    UR5Config: UR5Simulation,
}
"""The simulations of the robots, by configuration."""

TASKS: dict[type[TaskConfig], Callable[[Any, int, int], Task]] = {
    AvoidConfig: AvoidTask,
    NavigateConfig: NavigateTask,
    PickConfig: PickTask,
    ReachConfig: ReachTask,
}
"""The tasks, by configuration."""

BRAINS: dict[type[BrainConfig], Callable[[Any], Brain]] = {
    AvoidanceConfig: AvoidanceBrain,
    DaggerConfig: _Dagger,
    GapFollowerConfig: GapFollowerBrain,
    LanguageBrainConfig: LanguageBrain,
    LearnedBrainConfig: LearnedBrain,
    NavigatorConfig: NavigatorBrain,
    NoopConfig: NoopBrain,
    PickBrainConfig: PickBrain,
    RandomConfig: RandomBrain,
    ReachBrainConfig: ReachBrain,
}
"""The brains, by configuration."""


def robot_configs() -> dict[str, type[RobotConfig]]:
    """Return the configurations of the robots that can be simulated, by type."""
    return {config.get_choice_name(config): config for config in ROBOTS}


def check_robot_and_task(robot: Any, task: TaskConfig, program: str) -> None:
    """Refuse a robot that cannot be simulated, one whose rates do not divide each other, and another robot's task.

    Args:
        robot: the robot's configuration.
        task: the task's.
        program: the command that they are for; the message names it.

    Raises:
        ConfigError: names the value and the valid ones.
    """
    if robot.type not in robot_configs():
        raise ConfigError(
            f"robot.type is {robot.type!r}; {program} drives simulated robots: {', '.join(sorted(robot_configs()))}. "
            "Use lerobot-record or lerobot-rollout with another robot."
        )
    if (wanted := robot_of_task(task)) != robot.type:
        raise ConfigError(
            f"task.type is {task.get_choice_name(type(task))!r}, which is for robot.type = {wanted!r}; robot.type is "
            f"{robot.type!r}."
        )
    _ = robot.rates


def check_brain(key: str, brain: BrainConfig, robot_type: str) -> None:
    """Refuse a brain that is for another robot; `key` is the option that it comes from.

    Raises:
        ConfigError: names the brain, its robot, and the brains that fit.
    """
    try:
        driven = robot_of_brain(brain)
    except ConfigError as error:
        raise ConfigError(f"{key}: {error}") from error
    if driven not in ("", robot_type):
        raise ConfigError(
            f"{key}.type is {brain.get_choice_name(type(brain))!r}, which drives a {driven}; robot.type is "
            f"{robot_type!r}. Brains for it: {', '.join(brains_for(robot_type))}."
        )


def make_simulation(config: Any, n: int = 1, threads: int | None = None) -> Simulation:
    """Return n simulations of the robot that a configuration describes, on the lockstep clock whatever it says."""
    return ROBOTS[type(config)](config, n, threads)


def make_robot(config: Any, n: int = 1, threads: int | None = None) -> Simulation:
    """Return n robots on the clock that the configuration asks for.

    Raises:
        ConfigError: more than one on the wall clock.
        RealtimeError: the processes of a robot on the wall clock could not be started.
    """
    simulation = make_simulation(config, n, threads)
    return make_live(simulation, config.id) if config.clock == "realtime" else simulation


def make_task(config: TaskConfig, n: int, fps: int) -> Task:
    """Return the task that a configuration describes, for n simulations at `fps` frames a second."""
    return TASKS[type(config)](config, n, fps)


def robot_of_task(config: TaskConfig) -> str:
    """Return the type of the robot that a task is for."""
    task: Any = TASKS[type(config)]
    return str(task.robot_type)


def make_brain(config: BrainConfig) -> Brain:
    """Return the brain that a configuration describes."""
    return BRAINS[type(config)](config)


def robot_of_brain(config: BrainConfig) -> str:
    """Return the type of the robot that a brain is for, empty if it is for every robot.

    Raises:
        ConfigError: the brain is a trained policy, and there is no checkpoint where the configuration says.
    """
    brain: Any = BRAINS[type(config)]
    robot_type = str(brain.robot_of(config) if hasattr(brain, "robot_of") else brain.robot_type)
    return "" if robot_type == ANY_ROBOT else robot_type


def brains_for(robot_type: str) -> tuple[str, ...]:
    """Return the names of the brains for a type of robot."""
    brains: Any = BRAINS.values()
    return tuple(sorted(brain.name for brain in brains if brain.robot_type in (robot_type, ANY_ROBOT)))


def action_names_of(config: BrainConfig) -> tuple[str, ...]:
    """Return the names of the actions of the robots that a brain is for; none if it is for every robot."""
    robot: Any = robot_configs().get(robot_of_brain(config))
    simulation: Any = ROBOTS.get(robot)
    return tuple(simulation.action_names) if simulation else ()
