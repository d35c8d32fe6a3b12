"""Every robot, task and brain: its configuration, and what the configuration makes.

Those of this package are in the tables here; importing this module registers all of them, with LeRobot, too. Other
packages add theirs with `register_robot`, `register_task`, `register_brain` and `register_arena`.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from lerobot.robots.config import RobotConfig

import bhd_lerobot.robots.config_turtlebot3
import bhd_lerobot.robots.config_ur5
import bhd_lerobot.ros2.robots.config_robot
import bhd_lerobot.tasks.avoid
import bhd_lerobot.tasks.navigate
import bhd_lerobot.tasks.pick
import bhd_lerobot.tasks.reach  # noqa: F401  as the others above, registers its configuration
from bhd_lerobot.bodies.body import Body
from bhd_lerobot.bodies.registry import BODIES
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.options.registry import Registry, with_article
from bhd_lerobot.policies.baselines import NoopBrain, RandomBrain
from bhd_lerobot.policies.blanked import BlankedBrain, BlankedConfig
from bhd_lerobot.policies.brain import ANY_ROBOT, Brain, BrainConfig, ConfiguredBrain
from bhd_lerobot.policies.dagger.brain import DaggerBrain, DaggerConfig, check_drivers
from bhd_lerobot.policies.language.language_brain import LanguageBrain
from bhd_lerobot.policies.learned.brain import LearnedBrain
from bhd_lerobot.policies.manipulation.pick import PickBrain
from bhd_lerobot.policies.manipulation.reach import ReachBrain
from bhd_lerobot.policies.manipulation.servo import PickServoBrain, ReachServoBrain
from bhd_lerobot.policies.navigation.avoidance import AvoidanceBrain
from bhd_lerobot.policies.navigation.gap_follower import GapFollowerBrain
from bhd_lerobot.policies.navigation.navigator import NavigatorBrain
from bhd_lerobot.policies.teleop.brain import TeleopBrain
from bhd_lerobot.policies.topic.brain import TopicBrain
from bhd_lerobot.robots.external.config import GateConfig
from bhd_lerobot.robots.external.names import names_of_robot
from bhd_lerobot.tasks.free import FreeConfig
from bhd_lerobot.tasks.task import TASKS, Task, TaskConfig

if TYPE_CHECKING:  # LeRobot's commands import this module, whatever they are used for
    from bhd_lerobot.robots.host.robots import Robots
    from bhd_lerobot.robots.host.simulation import Simulation
    from bhd_lerobot.robots.robot import BhdRobot


class _Dagger(DaggerBrain):
    """A `dagger` brain, made of two of the brains below."""

    def __init__(self, config: DaggerConfig) -> None:
        super().__init__(config, make_brain(config.learner), make_brain(config.expert))

    @staticmethod
    def robot_of(config: DaggerConfig) -> str:
        """Return the robot that both drive.

        Raises:
            ConfigError: they drive different ones, or one of them gives goals.
        """
        check_drivers(BRAINS.of(config.learner), BRAINS.of(config.expert))
        learner, expert = robot_of_brain(config.learner), robot_of_brain(config.expert)
        for one, other in ((learner, expert), (expert, learner)):
            if is_for(one, other) or not other:
                return other or one or ANY_ROBOT
        raise ConfigError(
            f"brain.learner drives {with_article(learner)}, but brain.expert drives {with_article(expert)}."
        )


class _Blanked(BlankedBrain):
    """A `blanked` brain, made of one of the brains below."""

    def __init__(self, config: BlankedConfig) -> None:
        super().__init__(config, make_brain(config.brain))

    @staticmethod
    def robot_of(config: BlankedConfig) -> str:
        """Return the robot that the brain drives."""
        return robot_of_brain(config.brain)


_SIMULATIONS: dict[str, Any] = {
    "turtlebot3": "bhd_lerobot.robots.base_simulation:BaseSimulation",
    "ur5": "bhd_lerobot.robots.ur5_simulation:UR5Simulation",
}
ROBOTS: Registry[Any] = Registry("robot", _SIMULATIONS, RobotConfig)
"""The classes of the robots' simulations, by type; those of this package import MuJoCo."""

_CLASSES: tuple[Any, ...] = (
    *(AvoidanceBrain, _Blanked, _Dagger, GapFollowerBrain, LanguageBrain, LearnedBrain, NavigatorBrain, NoopBrain),
    *(PickBrain, PickServoBrain, RandomBrain, ReachBrain, ReachServoBrain, TeleopBrain, TopicBrain),
)
BRAINS: Registry[Any] = Registry("brain", {brain.name: brain for brain in _CLASSES}, BrainConfig)
"""The classes of the brains, by name."""


# --- registering -----------------------------------------------------------------------------------------------------


def register_robot[T: "type[BhdRobot]"](robot: T) -> T:
    """Register a simulated robot; a decorator of its class, which names its type, configuration and simulation.

    Raises:
        ConfigError: another robot has this name.
    """
    config: Any = robot.config_class
    ROBOTS.register(robot.name, robot.simulation_class, config)
    if robot.name not in BODIES:
        BODIES.register(robot.name, lambda: config().body())
    return robot


def register_task[T](name: str, config: type[TaskConfig]) -> Callable[[type[T]], type[T]]:
    """Return a decorator that registers a task's class under a name, with its configuration.

    Raises:
        ConfigError: another task has this name.
    """
    return _decorator(TASKS, name, config)


def register_brain[T](name: str, config: type[BrainConfig]) -> Callable[[type[T]], type[T]]:
    """Return a decorator that registers a brain's class under a name, with its configuration.

    Raises:
        ConfigError: another brain has this name, or the class is not derived from `ConfiguredBrain`.
    """

    def register(made: type[T]) -> type[T]:
        if not issubclass(made, ConfiguredBrain):
            raise ConfigError(
                f"The class of the brain {name!r}, {made.__name__}, is not derived from bhd_lerobot.ConfiguredBrain, "
                f"which defines what a brain may leave out: write class {made.__name__}(bhd.ConfiguredBrain)."
            )
        return _decorator(BRAINS, name, config)(made)

    return register


def _decorator[T](registry: Registry[Any], name: str, config: type) -> Callable[[type[T]], type[T]]:
    def register(made: type[T]) -> type[T]:
        made.name = name  # type: ignore[attr-defined]
        registry.register(name, made, config)
        return made

    return register


# --- what fits what --------------------------------------------------------------------------------------------------


def robot_configs() -> dict[str, type[RobotConfig]]:
    """Return the configurations of the robots that can be simulated, by type."""
    return {name: RobotConfig.get_choice_class(name) for name in ROBOTS}


def kind_of_robot(robot_type: str) -> str:
    """Return the kind of a robot that can be simulated: ``"base"`` or ``"arm"``; nothing if it is not known."""
    return str(ROBOTS[robot_type].robot_kind) if robot_type in ROBOTS else ""


def robots_of(wanted: str) -> list[str]:
    """Return the types of the robots that are of a kind, or of a type."""
    return sorted(name for name in ROBOTS if wanted in ("", name, kind_of_robot(name)))


def check_robot_and_task(robot: Any, task: TaskConfig, program: str) -> None:
    """Refuse a robot that cannot be simulated, one whose rates do not divide each other, and another robot's task."""
    kind = robot_of_task(task)
    if isinstance(task, FreeConfig) and not task.instruction.strip():
        raise ConfigError(
            "task.type is 'free', and task.instruction does not say what the robot is to do. Set "
            f"--task.instruction='…', or another --task.type: {', '.join(name for name in TASKS if name != 'free')}."
        )
    if not is_ours(robot.type):
        if kind:
            raise ConfigError(
                f"robot.type is {robot.type!r} and task.type is {task.get_choice_name(type(task))!r}, which {program} "
                f"simulates with {', '.join(robots_of(kind))} only. With another robot use --task.type=free: a person "
                "says how an episode ends."
            )
        return
    if robot.type not in (valid := robots_of(kind)):
        fitting = " or ".join(map(repr, valid))
        raise ConfigError(
            f"task.type is {task.get_choice_name(type(task))!r}, which is for robot.type = {fitting}; robot.type is "
            f"{robot.type!r}."
        )
    _ = robot.rates


def is_ours(robot_type: str) -> bool:
    """Return whether a robot has a cerebellum of this package; others are driven by their own interface."""
    return robot_type in ROBOTS


def check_brain(key: str, brain: BrainConfig, robot: RobotConfig) -> None:
    """Refuse a brain that is for another robot; `key` is the option that it comes from."""
    try:
        driven = robot_of_brain(brain)
    except ConfigError as error:
        raise ConfigError(f"{key}: {error}") from error
    robot_type = robot.type
    if not is_for(driven, robot_type) and driven not in names_of_robot(robot):
        path = getattr(brain, "path", None)
        name = f"{key}.path is {str(path)!r}" if path else f"{key}.type is {brain.get_choice_name(type(brain))!r}"
        raise ConfigError(
            f"{name}, which drives {with_article(driven)}; robot.type is {robot_type!r}. Brains for it: "
            f"{', '.join(brains_for(robot_type))}."
        )


def is_for(wanted: str, robot_type: str) -> bool:
    """Return whether a robot is of the kind or type that a task or a brain is for; nothing is every robot."""
    return wanted in ("", robot_type, kind_of_robot(robot_type))


def robot_of_task(config: TaskConfig) -> str:
    """Return the kind of robot that a task is for."""
    return str(TASKS.of(config).robot_kind)


def robot_of_brain(config: BrainConfig) -> str:
    """Return the kind or type of robot that a brain is for, empty if it is for every robot."""
    robot = str(BRAINS.of(config).robot_of(config))
    return "" if robot == ANY_ROBOT else robot


def brains_for(robot_type: str) -> tuple[str, ...]:
    """Return the names of the brains for a type of robot."""
    kinds = (kind_of_robot(robot_type), ANY_ROBOT)
    return tuple(sorted(name for name, brain in BRAINS.items() if brain.robot_kind in kinds))


def tasks_for(robot_type: str) -> tuple[str, ...]:
    """Return the names of the tasks for a type of robot."""
    return tuple(sorted(name for name, task in TASKS.items() if is_for(task.robot_kind, robot_type)))


def action_names_of(config: BrainConfig) -> tuple[str, ...]:
    """Return the names of the actions of the robots that a brain is for; none if it is for every robot."""
    wanted = robot_of_brain(config)
    robots = robots_of(wanted) if wanted else []
    return tuple(ROBOTS[robots[0]].action_names) if robots else ()


# --- making ----------------------------------------------------------------------------------------------------------


def make_simulation(config: Any, n: int = 1, threads: int | None = None) -> "Simulation":
    """Return n simulations of the robot that a configuration describes, on the lockstep clock whatever it says."""
    made: Simulation = ROBOTS.of(config)(config, n, threads)
    return made


def make_robot(
    config: Any, n: int = 1, threads: int | None = None, *, fps: int = 0, gate: GateConfig | None = None
) -> "Robots":
    """Return n robots on the clock that the configuration asks for; on the wall clock there can be one.

    Args:
        config: the robot's.
        n: how many.
        threads: threads that step the physics; all processors if None.
        fps: frames a second [Hz], of a robot of another package.
        gate: what is let through to one, likewise.
    """
    if not is_ours(config.type):
        from bhd_lerobot.robots.external.make import make_external

        return make_external(config, fps, gate or GateConfig())
    if config.clock != "realtime":
        return make_simulation(config, n, threads)
    if n != 1:
        raise ConfigError(f"n_envs is {n}; with robot.clock = 'realtime' one robot runs at a time: use --n_envs=1.")
    from bhd_lerobot.robots.host.realtime import make_live

    return make_live(ROBOTS.of(config), config, config.id)


def make_task(config: TaskConfig, n: int, fps: int, body: Body | None = None) -> Task:
    """Return the task that a configuration describes, for n simulations at `fps` frames a second [Hz]."""
    made: Task = TASKS.of(config)(config, n, fps, body)
    return made


def make_brain(config: BrainConfig) -> Brain:
    """Return the brain that a configuration describes."""
    made: Brain = BRAINS.of(config)(config)
    return made
