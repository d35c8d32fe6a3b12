"""Every robot, task and brain: its configuration, and what the configuration makes.

Those of this package are in the tables here; importing this module registers all of them, with LeRobot, too. Other
packages add theirs with `register_robot`, `register_task`, `register_brain` and `register_arena`.
"""

import pkgutil
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from lerobot.robots.config import RobotConfig

from bhd_lerobot.bodies.body import Body
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.plugins import BODIES
from bhd_lerobot.policies.baselines import NoopBrain, NoopConfig, RandomBrain, RandomConfig
from bhd_lerobot.policies.blanked import BlankedBrain, BlankedConfig
from bhd_lerobot.policies.brain import ANY_ROBOT, Brain, BrainConfig
from bhd_lerobot.policies.dagger.brain import DaggerBrain, DaggerConfig
from bhd_lerobot.policies.language.language_brain import LanguageBrain, LanguageBrainConfig
from bhd_lerobot.policies.learned.brain import LearnedBrain, LearnedBrainConfig
from bhd_lerobot.policies.manipulation.pick import PickBrain, PickBrainConfig
from bhd_lerobot.policies.manipulation.reach import ReachBrain, ReachBrainConfig
from bhd_lerobot.policies.manipulation.servo import (
    PickServoBrain,
    PickServoConfig,
    ReachServoBrain,
    ReachServoConfig,
)
from bhd_lerobot.policies.navigation.avoidance import AvoidanceBrain, AvoidanceConfig
from bhd_lerobot.policies.navigation.gap_follower import GapFollowerBrain, GapFollowerConfig
from bhd_lerobot.policies.navigation.navigator import NavigatorBrain, NavigatorConfig
from bhd_lerobot.robots.config_turtlebot3 import TurtleBot3Config
from bhd_lerobot.robots.config_ur5 import UR5Config
from bhd_lerobot.tasks.avoid import AvoidConfig, AvoidTask
from bhd_lerobot.tasks.navigate import NavigateConfig, NavigateTask
from bhd_lerobot.tasks.pick import PickConfig, PickTask
from bhd_lerobot.tasks.reach import ReachConfig, ReachTask
from bhd_lerobot.tasks.task import NEVER, Task, TaskConfig

if TYPE_CHECKING:  # LeRobot's commands import this module, whatever they are used for
    from bhd_lerobot.robots.host.host import Host
    from bhd_lerobot.robots.host.simulation import Simulation
    from bhd_lerobot.robots.simulated_robot import SimulatedRobot


class _Dagger(DaggerBrain):
    """A `dagger` brain, made of two of the brains below."""

    def __init__(self, config: DaggerConfig) -> None:
        super().__init__(config, make_brain(config.learner), make_brain(config.expert))

    @staticmethod
    def robot_of(config: DaggerConfig) -> str:
        """Return the robot that both drive.

        Raises:
            ConfigError: they drive different ones.
        """
        learner, expert = robot_of_brain(config.learner), robot_of_brain(config.expert)
        for one, other in ((learner, expert), (expert, learner)):
            if is_for(one, other) or not other:
                return other or one or ANY_ROBOT
        raise ConfigError(
            f"brain.learner drives {_with_article(learner)}, but brain.expert drives {_with_article(expert)}."
        )


class _Blanked(BlankedBrain):
    """A `blanked` brain, made of one of the brains below."""

    def __init__(self, config: BlankedConfig) -> None:
        super().__init__(config, make_brain(config.brain))

    @staticmethod
    def robot_of(config: BlankedConfig) -> str:
        """Return the robot that the brain drives."""
        return robot_of_brain(config.brain)


ROBOTS: dict[type[RobotConfig], "type[Simulation] | str"] = {
    TurtleBot3Config: "bhd_lerobot.robots.base_simulation:BaseSimulation",
    UR5Config: "bhd_lerobot.robots.ur5_simulation:UR5Simulation",
}
"""The simulations of the robots, by configuration: classes, or where they are, for those that import MuJoCo."""

TASKS: dict[type[TaskConfig], Callable[..., Task]] = {
    AvoidConfig: AvoidTask,
    NavigateConfig: NavigateTask,
    PickConfig: PickTask,
    ReachConfig: ReachTask,
}
"""The tasks, by configuration."""

BRAINS: dict[type[BrainConfig], Callable[[Any], Brain]] = {
    AvoidanceConfig: AvoidanceBrain,
    BlankedConfig: _Blanked,
    DaggerConfig: _Dagger,
    GapFollowerConfig: GapFollowerBrain,
    LanguageBrainConfig: LanguageBrain,
    LearnedBrainConfig: LearnedBrain,
    NavigatorConfig: NavigatorBrain,
    NoopConfig: NoopBrain,
    PickBrainConfig: PickBrain,
    PickServoConfig: PickServoBrain,
    RandomConfig: RandomBrain,
    ReachBrainConfig: ReachBrain,
    ReachServoConfig: ReachServoBrain,
}
"""The brains, by configuration."""


# --- registering -----------------------------------------------------------------------------------------------------


def register_robot[T: "type[SimulatedRobot]"](robot: T) -> T:
    """Register a simulated robot; a decorator of its class, which names its type, configuration and simulation.

    Raises:
        ConfigError: another robot has this name.
    """
    config: Any = robot.config_class
    _register(RobotConfig, ROBOTS, robot.name, config, robot.simulation_class)
    BODIES[robot.name] = lambda: config().body()
    return robot


def register_task[T](name: str, config: type[TaskConfig]) -> Callable[[type[T]], type[T]]:
    """Return a decorator that registers a task's class under a name, with its configuration.

    Raises:
        ConfigError: another task has this name.
    """

    def register(task: type[T]) -> type[T]:
        task.name = name  # type: ignore[attr-defined]
        _register(TaskConfig, TASKS, name, config, task)
        NEVER[name] = getattr(task, "never", ())
        return task

    return register


def register_brain[T](name: str, config: type[BrainConfig]) -> Callable[[type[T]], type[T]]:
    """Return a decorator that registers a brain's class under a name, with its configuration.

    Raises:
        ConfigError: another brain has this name.
    """

    def register(brain: type[T]) -> type[T]:
        brain.name = name  # type: ignore[attr-defined]
        _register(BrainConfig, BRAINS, name, config, brain)
        return brain

    return register


def _register(choices: Any, table: dict[Any, Any], name: str, config: type, made: Any) -> None:
    known = choices.get_known_choices().get(name)
    if known is not None and known is not config:
        raise ConfigError(
            f"There is a {_WORDS[choices]} {name!r} already, of {known.__module__}; that of {config.__module__} needs "
            "another name."
        )
    if known is None:
        choices.register_subclass(name)(config)
    table[config] = made


_WORDS: dict[Any, str] = {RobotConfig: "robot", TaskConfig: "task", BrainConfig: "brain"}


def _made_by(choices: Any, table: dict[Any, Any], config: Any) -> Any:
    """Return what a configuration's table says that it makes.

    Raises:
        ConfigError: its configuration was registered, and no class for it.
    """
    if type(config) not in table:
        word, name = _WORDS[choices], config.get_choice_name(type(config))
        raise ConfigError(
            f"The {word} {name!r} has a configuration, {type(config).__module__}.{type(config).__qualname__}, and no "
            f"class: register that with bhd_lerobot.register_{word}."
        )
    return _resolved(table[type(config)])


def _resolved(made: Any) -> Any:
    return pkgutil.resolve_name(made) if isinstance(made, str) else made


# --- what fits what --------------------------------------------------------------------------------------------------


def robot_configs() -> dict[str, type[RobotConfig]]:
    """Return the configurations of the robots that can be simulated, by type."""
    return {config.get_choice_name(config): config for config in ROBOTS}


def kind_of_robot(robot_type: str) -> str:
    """Return the kind of a robot that can be simulated: ``"base"`` or ``"arm"``; nothing if it is not known."""
    config = robot_configs().get(robot_type)
    return str(_resolved(ROBOTS[config]).robot_kind) if config else ""


def robots_of(wanted: str) -> list[str]:
    """Return the types of the robots that are of a kind, or of a type."""
    return sorted(name for name in robot_configs() if wanted in ("", name, kind_of_robot(name)))


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
    if robot.type not in (valid := robots_of(robot_of_task(task))):
        fitting = " or ".join(map(repr, valid))
        raise ConfigError(
            f"task.type is {task.get_choice_name(type(task))!r}, which is for robot.type = {fitting}; robot.type is "
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
    if not is_for(driven, robot_type):
        path = getattr(brain, "path", None)
        name = f"{key}.path is {str(path)!r}" if path else f"{key}.type is {brain.get_choice_name(type(brain))!r}"
        raise ConfigError(
            f"{name}, which drives {_with_article(driven)}; robot.type is {robot_type!r}. Brains for it: "
            f"{', '.join(brains_for(robot_type))}."
        )


def is_for(wanted: str, robot_type: str) -> bool:
    """Return whether a robot is of the kind or type that a task or a brain is for; nothing is every robot."""
    return wanted in ("", robot_type, kind_of_robot(robot_type))


def robot_of_task(config: TaskConfig) -> str:
    """Return the kind of robot that a task is for."""
    return str(_made_by(TaskConfig, TASKS, config).robot_kind)


def robot_of_brain(config: BrainConfig) -> str:
    """Return the kind or type of robot that a brain is for, empty if it is for every robot.

    Raises:
        ConfigError: the brain is a trained policy, and there is no checkpoint where the configuration says.
    """
    brain = _made_by(BrainConfig, BRAINS, config)
    robot = str(brain.robot_of(config) if hasattr(brain, "robot_of") else brain.robot_kind)
    return "" if robot == ANY_ROBOT else robot


def brains_for(robot_type: str) -> tuple[str, ...]:
    """Return the names of the brains for a type of robot."""
    brains: Any = BRAINS.values()
    kinds = (kind_of_robot(robot_type), ANY_ROBOT)
    return tuple(sorted(brain.name for brain in brains if brain.robot_kind in kinds))


def tasks_for(robot_type: str) -> tuple[str, ...]:
    """Return the names of the tasks for a type of robot."""
    tasks: Any = TASKS.values()
    return tuple(sorted(task.name for task in tasks if is_for(task.robot_kind, robot_type)))


def action_names_of(config: BrainConfig) -> tuple[str, ...]:
    """Return the names of the actions of the robots that a brain is for; none if it is for every robot."""
    wanted = robot_of_brain(config)
    robots = robots_of(wanted) if wanted else []
    return tuple(_resolved(ROBOTS[robot_configs()[robots[0]]]).action_names) if robots else ()


def _with_article(wanted: str) -> str:
    return f"{'an' if wanted[:1] in 'aeiou' else 'a'} {wanted}"


# --- making ----------------------------------------------------------------------------------------------------------


def make_simulation(config: Any, n: int = 1, threads: int | None = None) -> "Simulation":
    """Return n simulations of the robot that a configuration describes, on the lockstep clock whatever it says."""
    simulation: Any = _made_by(RobotConfig, ROBOTS, config)
    made: Simulation = simulation(config, n, threads)
    return made


def make_robot(config: Any, n: int = 1, threads: int | None = None) -> "Host":
    """Return n robots on the clock that the configuration asks for.

    Raises:
        ConfigError: more than one on the wall clock, or there is no such plant.
        RealtimeError: the processes of a robot on the wall clock could not be started.
    """
    if config.clock != "realtime":
        return make_simulation(config, n, threads)
    if n != 1:
        raise ConfigError(f"n_envs is {n}; with robot.clock = 'realtime' one robot runs at a time: use --n_envs=1.")
    from bhd_lerobot.robots.host.realtime import make_live

    return make_live(_made_by(RobotConfig, ROBOTS, config), config, config.id)


def make_task(config: TaskConfig, n: int, fps: int, body: Body | None = None) -> Task:
    """Return the task that a configuration describes, for n simulations at `fps` frames a second.

    Args:
        config: the configuration.
        n: number of simulations.
        fps: frames a second [Hz].
        body: the robot's hardware; a TurtleBot3's or a UR5's if None.
    """
    made: Task = _made_by(TaskConfig, TASKS, config)(config, n, fps, body)
    return made


def make_brain(config: BrainConfig) -> Brain:
    """Return the brain that a configuration describes."""
    made: Brain = _made_by(BrainConfig, BRAINS, config)(config)
    return made
