"""Every robot, task and brain: its configuration, and what the configuration makes.

Those of this package are in the tables here; importing this module registers all of them, with LeRobot, too. Other
packages add theirs with `register_robot`, `register_task`, `register_brain` and `register_arena`.
"""

from collections.abc import Callable, Mapping, Set
from dataclasses import fields
from functools import partial
from typing import TYPE_CHECKING, Any

from lerobot.robots.config import RobotConfig

import bhd_lerobot.robots.config_arm
import bhd_lerobot.robots.config_mobile_arm
import bhd_lerobot.robots.config_turtlebot3
import bhd_lerobot.robots.config_ur
import bhd_lerobot.ros2.robots.config_robot
import bhd_lerobot.tasks.avoid
import bhd_lerobot.tasks.fetch
import bhd_lerobot.tasks.navigate
import bhd_lerobot.tasks.pick
import bhd_lerobot.tasks.reach  # noqa: F401  as the others above, registers its configuration
from bhd_lerobot.bodies.body import PARTS, Body
from bhd_lerobot.bodies.registry import BODIES, parts_of_type
from bhd_lerobot.errors import ConfigError, DatasetError
from bhd_lerobot.options.registry import Registry, with_article
from bhd_lerobot.policies.baselines import NoopBrain, RandomBrain
from bhd_lerobot.policies.blanked import BlankedBrain, BlankedConfig
from bhd_lerobot.policies.brain import Brain, BrainConfig
from bhd_lerobot.policies.dagger.brain import DaggerBrain, DaggerConfig, check_drivers
from bhd_lerobot.policies.language.language_brain import LanguageBrain
from bhd_lerobot.policies.learned.brain import LearnedBrain
from bhd_lerobot.policies.manipulation.fetch import FetchBrain
from bhd_lerobot.policies.manipulation.pick import PickBrain
from bhd_lerobot.policies.manipulation.reach import ReachBrain
from bhd_lerobot.policies.manipulation.servo import PickServoBrain, ReachServoBrain
from bhd_lerobot.policies.navigation.avoidance import AvoidanceBrain
from bhd_lerobot.policies.navigation.gap_follower import GapFollowerBrain
from bhd_lerobot.policies.navigation.navigator import NavigatorBrain
from bhd_lerobot.policies.teleop.brain import TeleopBrain
from bhd_lerobot.policies.topic.brain import TopicBrain
from bhd_lerobot.robots.config import BhdRobotConfig
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
        """Return the type of robot that one of them is for.

        Raises:
            ConfigError: one of them gives goals.
        """
        check_drivers(BRAINS.of(config.learner), BRAINS.of(config.expert))
        return robot_of_brain(config.learner) or robot_of_brain(config.expert)


class _Blanked(BlankedBrain):
    """A `blanked` brain, made of one of the brains below."""

    def __init__(self, config: BlankedConfig) -> None:
        super().__init__(config, make_brain(config.brain))

    @staticmethod
    def robot_of(config: BlankedConfig) -> str:
        """Return the type of robot that the brain is for."""
        return robot_of_brain(config.brain)


def _own_robots() -> list[str]:
    """Return the types of the simulated robots of this package: others may be known to LeRobot already."""
    return sorted(
        name
        for name, config in RobotConfig.get_known_choices().items()
        if issubclass(config, BhdRobotConfig) and config.__module__.startswith(f"{__package__}.")
    )


_SIMULATION = "bhd_lerobot.robots.host.simulation:Simulation"
ROBOTS: Registry[Any] = Registry("robot", dict.fromkeys(_own_robots(), _SIMULATION), RobotConfig)
"""The classes of the robots' simulations, by type; those of this package import MuJoCo."""


def _body_of(robot_type: str) -> Body:
    body: Body = RobotConfig.get_choice_class(robot_type)().body()
    return body


for _type in ROBOTS.keys() - BODIES.keys():
    BODIES.register(_type, partial(_body_of, _type))

_CLASSES: tuple[Any, ...] = (
    *(AvoidanceBrain, _Blanked, _Dagger, FetchBrain, GapFollowerBrain, LanguageBrain, LearnedBrain, NavigatorBrain),
    *(NoopBrain, PickBrain, PickServoBrain, RandomBrain, ReachBrain, ReachServoBrain, TeleopBrain, TopicBrain),
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
        ConfigError: another task has this name, `needs` names what is no part, or the class is not derived from `Task`.
    """
    return _decorator(TASKS, name, config, Task)


def register_brain[T](name: str, config: type[BrainConfig]) -> Callable[[type[T]], type[T]]:
    """Return a decorator that registers a brain's class under a name, with its configuration.

    Raises:
        ConfigError: another brain has this name, `needs` names what is no part, or the class is not derived from
            `Brain`.
    """
    return _decorator(BRAINS, name, config, Brain)


def _decorator[T](registry: Registry[Any], name: str, config: type, base: type) -> Callable[[type[T]], type[T]]:
    def register(made: type[T]) -> type[T]:
        if not issubclass(made, base):
            word = base.__name__.lower()
            raise ConfigError(
                f"The class of the {word} {name!r}, {made.__name__}, is not derived from bhd_lerobot.{base.__name__}, "
                f"which defines what a {word} may leave out: write class {made.__name__}(bhd.{base.__name__})."
            )
        kind, needs = getattr(made, "robot_kind", None), getattr(made, "needs", None)
        if kind is not None or not isinstance(needs, tuple) or not set(needs) <= set(PARTS):
            given = f"needs = {needs!r}" if kind is None else f"robot_kind = {kind!r}"
            raise ConfigError(
                f"The class of {name!r}, {made.__name__}, has {given}. In place of robot_kind it says what parts its "
                "robot needs, a tuple of types: needs = (bhd.Drive, bhd.LidarSpec) or (bhd.Arm, bhd.GripperSpec), for "
                "example, or () for every robot."
            )
        made.name = name  # type: ignore[attr-defined]
        registry.register(name, made, config)
        return made

    return register


# --- what fits what --------------------------------------------------------------------------------------------------


def robot_configs() -> dict[str, type[RobotConfig]]:
    """Return the configurations of the robots that can be simulated, by type."""
    return {name: RobotConfig.get_choice_class(name) for name in ROBOTS}


def parts_of(robot: Any) -> Set[type]:
    """Return the parts of a robot's body, as in `Body.parts`; none of a robot of another package.

    Args:
        robot: its configuration; or its type, for the parts that it has by default.
    """
    if not is_ours(robot_type := robot if isinstance(robot, str) else robot.type):
        return frozenset()
    if isinstance(robot, str):
        return parts_of_type(robot_type)
    body: Body = robot.body()
    return body.parts.keys()


def robots_with(needs: Set[type], excludes: Set[type] = frozenset()) -> list[str]:
    """Return the types of the robots that have some parts, and others not."""
    return sorted(name for name in ROBOTS if needs <= (parts := parts_of(name)) and not excludes & parts)


def check_robot_and_task(robot: Any, task: TaskConfig, program: str) -> None:
    """Refuse a robot that cannot be simulated, one whose rates do not divide each other, and another robot's task."""
    if isinstance(task, FreeConfig) and not task.instruction.strip():
        raise ConfigError(
            "task.type is 'free', and task.instruction does not say what the robot is to do. Set "
            f"--task.instruction='…', or another --task.type: {', '.join(name for name in TASKS if name != 'free')}."
        )
    if is_ours(robot.type):
        check_task(task, robot)
        _ = robot.rates
    elif needs := needs_of_task(task):
        raise ConfigError(
            f"robot.type is {robot.type!r} and task.type is {task.get_choice_name(type(task))!r}, which {program} "
            f"simulates with {', '.join(robots_with(needs, _excludes(TASKS.of(task))))} only. With another robot use "
            "--task.type=free: a person says how an episode ends."
        )


def check_task(task: TaskConfig, robot: Any) -> None:
    """Refuse a task that needs a part that a robot does not have, or that is for robots without one that it has."""
    needs, excludes, parts = needs_of_task(task), _excludes(TASKS.of(task)), parts_of(robot)
    if missing := needs - parts:
        problem = f"needs {_listed(missing)}", "which has none"
    elif extra := excludes & parts:
        problem = f"is for robots without {_listed(extra)}", "which has one"
    else:
        return
    raise ConfigError(
        f"task.type is {task.get_choice_name(type(task))!r}, which {problem[0]}; robot.type is {robot.type!r}, "
        f"{problem[1]}. Valid: {', '.join(robots_with(needs, excludes)) or 'none'}. Tasks of {robot.type}: "
        f"{', '.join(tasks_for(robot))}."
    )


def _excludes(kind: Any) -> Set[type]:
    return frozenset(getattr(kind, "excludes", ()))


def is_ours(robot_type: str) -> bool:
    """Return whether a robot has a cerebellum of this package; others are driven by their own interface."""
    return robot_type in ROBOTS


def check_brain(key: str, brain: BrainConfig, robot: RobotConfig) -> None:
    """Refuse a brain that is for another robot, or is made of one; `key` is the option that it comes from."""
    try:
        robot_type = robot_of_brain(brain)
    except ConfigError as error:
        raise ConfigError(f"{key}: {error}") from error
    for name, part in _composed_of(brain).items():
        check_brain(f"{key}.{name}", part, robot)
    missing, is_robot = needs_of_brain(brain) - parts_of(robot), f"robot.type is {robot.type!r}"
    if robot_type not in ("", robot.type, *names_of_robot(robot)):
        problem = f"drives {with_article(robot_type)}; {is_robot}"
    elif missing:
        has = "which has none" if is_ours(robot.type) else "whose parts are not known"
        problem = f"needs {_listed(missing)}; {is_robot}, {has}"
    else:
        return
    path = getattr(brain, "path", None)
    name = f"{key}.path is {str(path)!r}" if path else f"{key}.type is {brain.get_choice_name(type(brain))!r}"
    raise ConfigError(f"{name}, which {problem}. Brains for it: {', '.join(brains_for(robot))}.")


def drives(brain: BrainConfig, robot: Any) -> bool:
    """Return whether a robot, given as in `parts_of`, has the parts for a brain, and is the one it was trained on."""
    robot_type = robot if isinstance(robot, str) else robot.type
    return robot_of_brain(brain) in ("", robot_type) and needs_of_brain(brain) <= parts_of(robot)


def needs_of_task(config: TaskConfig) -> Set[type]:
    """Return the parts that a robot needs for a task."""
    return frozenset(TASKS.of(config).needs)


def needs_of_brain(config: BrainConfig) -> Set[type]:
    """Return the parts that a robot needs for a brain, and for those that it is made of."""
    return frozenset(BRAINS.of(config).needs).union(*map(needs_of_brain, _composed_of(config).values()))


def robot_of_brain(config: BrainConfig) -> str:
    """Return the type of robot that a brain is for; empty if it drives every robot with the parts that it needs."""
    return str(BRAINS.of(config).robot_of(config))


def _composed_of(config: BrainConfig) -> dict[str, BrainConfig]:
    return {name: value for name, value in vars(config).items() if isinstance(value, BrainConfig)}


def _listed(parts: Set[type]) -> str:
    return " and ".join(with_article(name) for part, name in PARTS.items() if part in parts)


def brains_for(robot: Any) -> tuple[str, ...]:
    """Return the names of the brains for a robot, given its configuration or its type."""
    parts = parts_of(robot)
    return tuple(sorted(name for name, brain in BRAINS.items() if set(brain.needs) <= parts))


def tasks_for(robot: Any) -> tuple[str, ...]:
    """Return the names of the tasks for a robot, given its configuration or its type."""
    parts = parts_of(robot)
    fitting = (name for name, task in TASKS.items() if set(task.needs) <= parts and not _excludes(task) & parts)
    return tuple(sorted(fitting))


def action_names_of(config: BrainConfig) -> tuple[str, ...]:
    """Return the names of the actions of the robots that a brain is for; none if it is for every robot."""
    robots = [name for name in sorted(ROBOTS) if drives(config, name)]
    return BODIES[robots[0]]().limits.names if 0 < len(robots) < len(ROBOTS) else ()


# --- making ----------------------------------------------------------------------------------------------------------


def recorded_robot(recorded: Mapping[str, Any]) -> Any:
    """Return the configuration of the robot that recorded a dataset, in simulated time and without cameras.

    Args:
        recorded: its options, as the dataset names them.

    Raises:
        DatasetError: there is no such robot.
    """
    try:
        kind = RobotConfig.get_choice_class(recorded["type"])
    except KeyError:
        raise DatasetError(f"The dataset was recorded by an unknown robot, {recorded.get('type')!r}.") from None
    known = {field.name for field in fields(kind)}
    parameters = {key: value for key, value in recorded.items() if key in known and key != "realtime"}
    return kind(**{**parameters, "camera": False, "clock": "lockstep"})


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
        gate: what is let through to one; of ours there is none.
    """
    if not is_ours(config.type):
        from bhd_lerobot.robots.external.make import make_external

        return make_external(config, fps, gate or GateConfig())
    if gate is not None and gate != GateConfig():
        raise ConfigError(
            f"gate is of robots of other packages, and robot.type is {config.type!r}, whose cerebellum keeps its "
            "body's limits. Leave gate out."
        )
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
