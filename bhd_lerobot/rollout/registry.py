"""Which brain, which task and which simulation belong to a configuration."""

from collections.abc import Callable
from typing import Any

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
from bhd_lerobot.robots.catalog import SIMULATED_ROBOTS, SIMULATIONS, make_robot, make_simulation
from bhd_lerobot.tasks.catalog import make_task, robot_of_task

__all__ = [
    "SIMULATED_ROBOTS",
    "action_names_of",
    "brains_for",
    "make_brain",
    "make_robot",
    "make_simulation",
    "make_task",
    "robot_of_brain",
    "robot_of_task",
]


class _Dagger(DaggerBrain):
    """A `dagger` brain, made of two of the brains below."""

    def __init__(self, config: DaggerConfig) -> None:
        super().__init__(config, make_brain(config.learner), make_brain(config.expert))

    @staticmethod
    def robot_of(config: DaggerConfig) -> str:
        """Return the robot that both drive."""
        return robot_of_both(*(robot_of_brain(one) or ANY_ROBOT for one in (config.learner, config.expert)))


# Importing this module registers every configuration that it names.
_BRAINS: dict[type, Callable[[Any], Brain]] = {
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


def make_brain(config: BrainConfig) -> Brain:
    """Return the brain that a configuration describes."""
    return _BRAINS[type(config)](config)


def action_names_of(config: BrainConfig) -> tuple[str, ...]:
    """Return the names of the actions of the robots that a brain is for; none if it is for every robot."""
    simulations = {kind.get_choice_name(kind): simulation for kind, simulation in SIMULATIONS.items()}
    simulation: Any = simulations.get(robot_of_brain(config))
    return tuple(simulation.action_names) if simulation else ()


def robot_of_brain(config: BrainConfig) -> str:
    """Return the type of the robot that a brain is for, nothing ("") if it is for every robot.

    Raises:
        ConfigError: the brain is a trained policy, and what lies where the configuration says is none.
    """
    brain: Any = _BRAINS[type(config)]
    robot_type = str(brain.robot_of(config) if hasattr(brain, "robot_of") else brain.robot_type)
    return "" if robot_type == ANY_ROBOT else robot_type


def brains_for(robot_type: str) -> tuple[str, ...]:
    """Return the names of the brains for a type of robot."""
    brains: Any = _BRAINS.values()
    return tuple(sorted(brain.name for brain in brains if brain.robot_type in (robot_type, ANY_ROBOT)))
