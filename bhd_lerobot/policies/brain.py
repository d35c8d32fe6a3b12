"""What a brain is: a few times a second it receives an observation and returns a setpoint or a goal."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar

import draccus
import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import PARTS, Body
from bhd_lerobot.control.commands import Command, CommandResult
from bhd_lerobot.errors import ConfigError, brief
from bhd_lerobot.options.declared import Options, some_of


class BrainConfig(Options, draccus.ChoiceRegistry, prefix="brain."):
    """Base class of brain configurations.

    Attributes:
        is_composed: whether its options hold other brains.
    """

    is_composed: ClassVar[bool] = False


if TYPE_CHECKING:
    DriverConfig = BrainConfig
else:
    DriverConfig = some_of(BrainConfig, lambda choice: not choice.is_composed)
    """The configurations of brains that are not made of others, for options of those that are."""


@dataclass(frozen=True)
class Observation:
    """What n robots see at one time.

    Attributes:
        names: feature names of the columns of `state`.
        state: the robots' floats, shape (n, len(names)), read-only.
        images: by camera name, shape (n, height, width, 3), RGB.
        environment_state: privileged: what the task reports of the simulator's truth, shape (n, k), or None.
        results: how goals ended since the last observation, by simulation.
        running: which simulations are in an episode, shape (n,); all if None. What the others see means nothing.
    """

    names: tuple[str, ...]
    state: NDArray[np.float64]
    images: dict[str, NDArray[np.uint8]] = field(default_factory=dict)
    environment_state: NDArray[np.float64] | None = None
    results: Mapping[int, Sequence[CommandResult]] = field(default_factory=dict)
    running: NDArray[np.bool_] | None = None


@dataclass(frozen=True)
class RobotFeatures:
    """What a brain needs to know of the robots that it will drive.

    Attributes:
        observation_names: features of the observation's floats, in order.
        action_names: features of the action, in order.
        fps: frames a second [Hz].
        environment_names: names of what the task reports to the brain, in order; empty if nothing.
        body: the robot's hardware; None if it is not known.
        cameras: image shapes (height, width, channels) [px] by camera name; None if they are not known.
        robot_type: the robot's type; nothing if it is not known.
        robot: the robot's options; empty if they are not known.
    """

    observation_names: Sequence[str]
    action_names: Sequence[str]
    fps: int
    environment_names: Sequence[str] = ()
    body: Body | None = None
    cameras: Mapping[str, tuple[int, int, int]] | None = None
    robot_type: str = ""
    robot: Mapping[str, Any] = field(default_factory=dict)

    def need[P](self, part: type[P]) -> P:
        """Return a part of the robot.

        Raises:
            ConfigError: it does not have it, or its hardware is not known.
        """
        if self.body is None:
            raise ConfigError(f"The robot's hardware is not known, and its {PARTS[part]} is needed here.")
        return self.body.need(part)


class Brain:
    """A rule or a network that drives n robots.

    A brain learns once which features it will see and which it must command; it finds its inputs by name and fails at
    once, with the names it misses, if they are not there. A subclass sets `needs` and defines `bind` and `act`. What
    else it may offer is as it is here otherwise: no images, no plan and no expert.

    Attributes:
        config: the parameters.
        needs: the parts that a robot needs for it, such as ``(Drive, LidarSpec)``; empty if every robot may do.
        uses_images: whether `act` uses the observation's images. If not, it is not kept waiting for them and may get
            none.
        uses_privileged_state: whether `act` uses the observation's `environment_state`, which no sensor measures. If
            not, it gets none. Of one that does not say, it is taken for granted that it uses what the task reports.
        has_plan: whether it works step by step, and `subtasks` and `plan` say what it does.
        attempts: whether it attempts the task; of one that does not, no episode has an outcome that means anything.
    """

    name: str
    needs: tuple[type, ...] = ()
    uses_images = False
    uses_privileged_state: bool = True
    has_plan = False
    attempts = True

    def __init__(self, config: Any) -> None:
        self.config = config

    @classmethod
    def robot_of(cls, config: Any) -> str:
        """Return the type of robot that a brain of this configuration is for; empty if every one with the parts."""
        return ""

    def bind(self, robot: RobotFeatures) -> None:
        """Learn what robot it will drive.

        Raises:
            ConfigError: a feature or a camera that the brain needs is missing, or not as it needs it.
        """
        raise NotImplementedError

    def reset(self, ids: NDArray[np.intp], seeds: Sequence[int], n: int, instructions: Sequence[str] = ()) -> None:
        """Start episodes in some of n simulations: forget what was seen there.

        Args:
            ids: the simulations.
            seeds: a seed for each of them; all that is random in the brain follows from it.
            n: number of simulations that `act` will be called for.
            instructions: the instruction of each of them, if there are any.
        """

    def subtasks(self) -> Sequence[str]:
        """Return what the brain is doing in each simulation, as text; of a brain that `has_plan`."""
        return ()

    def plan(self, sim: int) -> dict[str, Any]:
        """Return the plan of one simulation, as plain values; of a brain that `has_plan`."""
        return {}

    def act(self, observation: Observation) -> Command:
        """Return the command of n robots for this frame.

        A brain returns goals always or never; among them may be setpoints, for robots that follow none.
        """
        raise NotImplementedError

    def needs_images(self, results: Mapping[int, Sequence[CommandResult]]) -> NDArray[np.bool_]:
        """Return in which simulations the next `act` uses images; in the others it may get black ones.

        Args:
            results: what the next observation will have as its results.

        Returns:
            Shape (n,), or () for all of them.
        """
        return np.array(self.uses_images)

    def advice(self) -> NDArray[np.float64] | None:
        """Return what an expert would do in the frame that `act` decided last, shape (n, actions); None without one.

        NaN where that is what is done.
        """
        return None

    def interventions(self) -> NDArray[np.bool_] | None:
        """Return which robots an expert drives in the frame that `act` decided last, shape (n,); None without one."""
        return None

    def causes(self) -> Sequence[str]:
        """Return why the expert took over last, as text, of each simulation; empty without a takeover in this episode.

        Called only where `interventions` is true of a robot.
        """
        return ()

    def close(self) -> None:
        """Let go of what it holds, a device for example; may be called twice."""

    def parameters(self) -> dict[str, Any]:
        """Return everything that defines the brain, as plain values."""
        return {"type": self.name, **asdict(self.config)}


ConfiguredBrain = Brain
"""The name by which plug-ins of version 0.3 know it."""


def is_privileged(brain: Brain, environment_names: Sequence[str]) -> bool:
    """Return whether a brain acts on what no sensor tells: it uses the environment state, and the task reports one."""
    return bool(environment_names) and brain.uses_privileged_state


def find_columns(names: Sequence[str], wanted: Sequence[str], who: str, what: str) -> NDArray[np.intp]:
    """Return where features lie.

    Args:
        names: the features there are, in order.
        wanted: the features to find.
        who: name of the brain, for the message.
        what: ``"observation"``, ``"action"`` or ``"environment"``, for the message.

    Raises:
        ConfigError: some are missing; the message names them.
    """
    index = {name: column for column, name in enumerate(names)}
    missing = [name for name in wanted if name not in index]
    if missing:
        whose = "task or scene does not report" if what == "environment" else "robot does not have"
        raise ConfigError(
            f"The brain {who!r} needs the {what} feature(s) {brief(missing, 3)}, which this {whose}. "
            f"There is: {', '.join(names[:8]) or 'nothing'}{', …' if len(names) > 8 else ''}."
        )
    return np.array([index[name] for name in wanted], np.intp)


def find_scan(names: Sequence[str], who: str) -> tuple[slice, NDArray[np.float64]]:
    """Return where the range finder's beams lie, and their directions.

    Beams are named ``scan_000.pos`` and so on, in order: beam 0 straight ahead, counter-clockwise, evenly spaced.

    Returns:
        The columns, which are neighbours, and the beams' angles in the robot's frame [rad], in [-pi, pi),
        shape (beams,)

    Raises:
        ConfigError: there is no scan.
    """
    columns = [column for column, name in enumerate(names) if name.startswith("scan_") and name.endswith(".pos")]
    if not columns or columns != list(range(columns[0], columns[0] + len(columns))):
        raise ConfigError(
            f"The brain {who!r} needs a range scan (scan_000.pos, scan_001.pos, …), which this robot does not have. "
            "Choose a robot with a lidar, turtlebot3 for example."
        )
    angles = 2 * np.pi * np.arange(len(columns)) / len(columns)
    return slice(columns[0], columns[-1] + 1), (angles + np.pi) % (2 * np.pi) - np.pi
