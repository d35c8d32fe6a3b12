"""Which brain, which task and which simulation belong to a configuration."""

from collections.abc import Callable
from typing import Any

from lerobot.robots.config import RobotConfig

from bhd_lerobot.policies.avoidance import AvoidanceBrain, AvoidanceConfig
from bhd_lerobot.policies.brain import Brain
from bhd_lerobot.policies.config_brain import BrainConfig
from bhd_lerobot.policies.gap_follower import GapFollowerBrain, GapFollowerConfig
from bhd_lerobot.policies.language_brain import LanguageBrain, LanguageBrainConfig
from bhd_lerobot.policies.pick import PickBrain, PickBrainConfig
from bhd_lerobot.policies.reach import ReachBrain, ReachBrainConfig
from bhd_lerobot.robots.config_turtlebot3 import TurtleBot3Config
from bhd_lerobot.robots.config_ur5 import UR5Config
from bhd_lerobot.robots.live_simulation import make_live
from bhd_lerobot.robots.simulation import Simulation
from bhd_lerobot.robots.turtlebot3_simulation import TurtleBot3Simulation
from bhd_lerobot.robots.ur5_simulation import UR5Simulation
from bhd_lerobot.tasks.avoid import AvoidConfig, AvoidTask
from bhd_lerobot.tasks.config_task import TaskConfig
from bhd_lerobot.tasks.pick import PickConfig, PickTask
from bhd_lerobot.tasks.reach import ReachConfig, ReachTask
from bhd_lerobot.tasks.task import Task

# Importing this module registers every configuration that it names.
_BRAINS: dict[type, Callable[[Any], Brain]] = {
    AvoidanceConfig: AvoidanceBrain,
    GapFollowerConfig: GapFollowerBrain,
    LanguageBrainConfig: LanguageBrain,
    PickBrainConfig: PickBrain,
    ReachBrainConfig: ReachBrain,
}
_TASKS: dict[type, Callable[[Any, int, int], Task]] = {
    AvoidConfig: AvoidTask,
    PickConfig: PickTask,
    ReachConfig: ReachTask,
}
_SIMULATIONS: dict[type[RobotConfig], Callable[[Any, int, int | None], Simulation]] = {
    TurtleBot3Config: TurtleBot3Simulation,
    UR5Config: UR5Simulation,
}

SIMULATED_ROBOTS = tuple(_SIMULATIONS)
"""Configurations of the robots that can be simulated."""


def make_simulation(config: Any, n: int = 1, threads: int | None = None) -> Simulation:
    """Return n simulations of the robot that a configuration describes, on the lockstep clock whatever it says."""
    return _SIMULATIONS[type(config)](config, n, threads)


def make_robot(config: Any, n: int = 1, threads: int | None = None) -> Simulation:
    """Return n robots on the clock that the configuration asks for.

    Raises:
        ConfigError: more than one on the wall clock.
        RealtimeError: the processes of a robot on the wall clock could not be started.
    """
    simulation = make_simulation(config, n, threads)
    return make_live(simulation, config.id) if config.clock == "realtime" else simulation


def make_brain(config: BrainConfig) -> Brain:
    """Return the brain that a configuration describes."""
    return _BRAINS[type(config)](config)


def action_names_of(config: BrainConfig) -> tuple[str, ...]:
    """Return the names of the actions of the robots that a brain is for."""
    simulations = {kind.get_choice_name(kind): simulation for kind, simulation in _SIMULATIONS.items()}
    simulation: Any = simulations[robot_of_brain(config)]
    return tuple(simulation.action_names)


def robot_of_brain(config: BrainConfig) -> str:
    """Return the type of the robot that a brain is for."""
    brain: Any = _BRAINS[type(config)]
    return str(brain.robot_type)


def brains_for(robot_type: str) -> tuple[str, ...]:
    """Return the names of the brains for a type of robot."""
    brains: Any = _BRAINS.values()
    return tuple(sorted(brain.name for brain in brains if brain.robot_type == robot_type))


def robot_of_task(config: TaskConfig) -> str:
    """Return the type of the robot that a task is for."""
    task: Any = _TASKS[type(config)]
    return str(task.robot_type)


def make_task(config: TaskConfig, n: int, fps: int) -> Task:
    """Return the task that a configuration describes, for n simulations at `fps` frames a second."""
    return _TASKS[type(config)](config, n, fps)
