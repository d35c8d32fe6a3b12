"""What a task is: it makes episodes from seeds and judges them on the simulator's truth."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from enum import IntEnum
from functools import cached_property
from typing import Any, ClassVar, Literal

import draccus
import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.arenas import Arena, make_arena
from bhd_lerobot.bodies.body import Arm, Body, Drive
from bhd_lerobot.bodies.registry import body_with
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.options.declared import Options
from bhd_lerobot.options.registry import Registry


class TaskConfig(Options, draccus.ChoiceRegistry, prefix="task."):
    """Base class of task configurations."""


_OWN: dict[str, Any] = {
    "avoid": "bhd_lerobot.tasks.avoid:AvoidTask",
    "fetch": "bhd_lerobot.tasks.fetch:FetchTask",
    "free": "bhd_lerobot.tasks.free:FreeTask",
    "navigate": "bhd_lerobot.tasks.navigate:NavigateTask",
    "pick": "bhd_lerobot.tasks.pick:PickTask",
    "reach": "bhd_lerobot.tasks.reach:ReachTask",
}
TASKS: Registry[Any] = Registry("task", _OWN, TaskConfig)
"""The classes of the tasks, by name."""


Split = Literal["train", "held_out", "validation"]
SPLITS: tuple[Split, ...] = ("train", "held_out", "validation")
_VALIDATION, _FAR = 1, 2  # make other episodes of a run's seed and numbers
_WORD = 2**32  # NumPy takes a larger number for several: k + 2**32 for k, 1


class Event(IntEnum):
    """What happened in a frame; the `event` column of a dataset."""

    NOTHING = 0
    SUCCESS = 1
    COLLISION = 2
    STUCK = 3
    TIMEOUT = 4
    INTERVENTION = 5
    ESTOP = 6
    WRONG_OBJECT = 7
    DROPPED = 8
    UNREACHABLE = 9
    FAULT = 10
    FAILURE = 11  # without a cause: only a person says so

    @property
    def cause(self) -> str:
        """The event's name in an episode's metadata."""
        return self.name.lower()


OUTCOMES = tuple(event.cause for event in Event if event not in (Event.NOTHING, Event.INTERVENTION))
"""The events that an episode can end with, by name."""


def outcomes_of(task: str | None, body: Body | None = None) -> tuple[str, ...]:
    """Return what an episode can end with, by name, whatever ended it.

    Args:
        task: the task's type; None if it is not known.
        body: the robot's hardware; None if it is not known.
    """
    grasping = (Event.WRONG_OBJECT, Event.DROPPED) if body and not body.arm else ()
    known = getattr(TASKS[task], "never", ()) if task and task in TASKS else ()  # of one that is not known, anything
    never = {event.cause for event in (*known, *grasping)}
    return tuple(name for name in OUTCOMES if name not in never)


def episode_seed(seed: int, episode: int, split: Split) -> int:
    """Return the seed of an episode, a whole number below 2**63.

    Training seeds are even, and all others are odd, so that they can never meet, whatever run they come from. Held-out
    episodes are for what is reported; those of validation are to choose by, while a policy is trained. These two are
    drawn apart, and have a seed in common with a probability of 2**-62.

    Args:
        seed: the run's seed.
        episode: the episode's number in the run.
        split: which of the sets the episode belongs to.
    """
    if split not in SPLITS:
        raise ConfigError(f"Unknown split {split!r}. Valid: {', '.join(SPLITS)}.")
    if seed < 0 or episode < 0:
        raise ConfigError(f"Seeds and episode numbers start at 0; got seed {seed}, episode {episode}.")
    words = [seed, episode]
    if split == "validation":
        words.append(_VALIDATION)
    elif split == "held_out" and max(words) >= _WORD:
        words.append(_FAR)  # so that it is no episode of validation
    word = np.random.SeedSequence(words).generate_state(1, np.uint64)[0]
    return (int(word) >> 2) * 2 + int(split != "train")


@dataclass(frozen=True)
class Outcome:
    """How an episode ended.

    Attributes:
        success: whether the task was achieved.
        event: what ended it.
        score: between 0 and 1, more is better; defined by the task.
        details: further numbers, by name.
    """

    success: bool
    event: Event
    score: float
    details: dict[str, float] = field(default_factory=dict)


class Task:
    """A task for n simulations at once; each of them is in an episode of its own.

    A subclass defines `sample`, `instruction`, `judge` and `outcome`, and whatever else is not as it is here.

    Attributes:
        name: its name.
        needs: the parts that a robot needs for it, types of `bhd_lerobot.bodies.body`; empty if every robot can do it.
        excludes: the parts that a robot must not have for it.
        environment_names: names of what the task reports to the brain, in order; empty if nothing.
        lasts: whether success is to have lasted until the time is over; an episode is then truncated, not terminated.
        judged_by: the fields of the truth without which it cannot be judged; None if it takes a simulator's.
        notes: what a person has to know before the episodes begin.
        never: events that cannot happen in this task.
        config: the parameters.
        body: the robot's hardware; None if it is not known.
        fps: frames a second [Hz].
        duration_s: longest duration of an episode [s].
        max_frames: the same [frames].
        frame: frames of each episode so far, shape (n,); `begin` sets them to 0, `count_frame` counts.

    Args:
        config: the parameters, with a `duration_s`.
        n: number of simulations.
        fps: frames a second [Hz].
        body: the robot's hardware; if None, that of the first robot that has the parts.
    """

    name: str
    needs: tuple[type, ...] = ()
    excludes: tuple[type, ...] = ()
    environment_names: tuple[str, ...] = ()
    lasts = False
    judged_by: frozenset[str] | None = None
    notes: tuple[str, ...] = ()
    never: ClassVar[tuple[Event, ...]] = ()

    def __init__(self, config: Any, n: int, fps: int, body: Body | None = None) -> None:
        self.config, self.body = config, body
        self.duration_s: float = config.duration_s
        self.fps = fps
        self.max_frames = self.in_frames(config.duration_s)
        self._sims = np.arange(n)
        self.frame: NDArray[np.int64] = np.zeros(n, np.int64)

    def in_frames(self, seconds: float) -> int:
        """Return a time in frames, at least 1."""
        return max(1, round(seconds * self.fps))

    def sample(self, seed: int) -> Any:
        """Return the scene of the episode with this seed: an `Arena` or a `TableScene`."""
        raise NotImplementedError

    def instruction(self, scene: Any) -> str:
        """Return what a person would ask for in this scene."""
        raise NotImplementedError

    def begin(self, ids: NDArray[np.intp], scenes: Sequence[Any]) -> None:
        """Start episodes in some simulations."""
        self.frame[ids] = 0

    def count_frame(self, running: NDArray[np.bool_]) -> NDArray[np.int64]:
        """Count a frame of the simulations that are running.

        Returns:
            `Event.TIMEOUT` where the time is over, and `Event.NOTHING` elsewhere, shape (n,)
        """
        self.frame += running
        return np.where(running & (self.frame >= self.max_frames), int(Event.TIMEOUT), int(Event.NOTHING))

    def environment_state(self, truth: Any) -> NDArray[np.float64]:
        """Return what the task reports to the brain now, shape (n, len(environment_names))."""
        return np.zeros((len(self._sims), 0))

    def privileged_state(self) -> NDArray[np.float64]:
        """Return what decides an outcome and no brain is told, numbers around 1, shape (n, any); for a critic.

        How much time is left is not among it: an episode whose time is over is truncated, and its value continues.
        """
        return np.zeros((len(self._sims), 0))

    def judge(self, truth: Any, running: NDArray[np.bool_]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Return the reward and the `Event` of the frame that just ended, each of shape (n,).

        An event other than `NOTHING` ends the episode. Simulations that are not running get 0.
        """
        raise NotImplementedError

    def outcome(self, sim: int, event: Event) -> Outcome:
        """Return how the episode of one simulation ended, given the event that ended it."""
        raise NotImplementedError

    def parameters(self) -> dict[str, Any]:
        """Return everything that defines the task, as plain values."""
        return {"type": self.name, **asdict(self.config)}


class BaseTask(Task):
    """What the tasks of bases have in common: arenas with room for the robot."""

    needs: tuple[type, ...] = (Drive,)

    def arena(self, name: str, seed: int, random_start: bool = False) -> Arena:
        """Return an arena that this robot can get through."""
        radius = (self.body or body_with(Drive)).need(Drive).radius
        return make_arena(name, seed, random_start, robot_radius=radius)


class ArmTask(Task):
    """What the tasks of arms have in common; their scenes are `TableScene`."""

    needs: tuple[type, ...] = (Arm,)
    excludes = (Drive,)  # it is told where things are in the world frame, which is that of an arm that stands

    @cached_property
    def arm(self) -> Arm:
        """The robot's arm."""
        return (self.body or body_with(Arm)).need(Arm)


class PathLengths:
    """How far n robots have driven in their episodes, in all and lately.

    Attributes:
        total: in all [m], shape (n,).
        recent: in the last `window` frames [m], shape (n,).
    """

    def __init__(self, n: int, window: int) -> None:
        self.total, self.recent = np.zeros(n), np.zeros(n)
        self._history = np.zeros((window, n))  # totals of the last frames, a ring

    def begin(self, ids: NDArray[np.intp]) -> None:
        """Start episodes in some simulations."""
        self.total[ids] = self.recent[ids] = 0.0
        self._history[:, ids] = 0.0

    def add(self, step: NDArray[np.float64], frame: NDArray[np.int64]) -> NDArray[np.float64]:
        """Add what each robot drove in a frame [m], and return what it drove in the last `window` frames [m].

        Args:
            step: shape (n,).
            frame: number of each episode's frame, from 0, shape (n,).
        """
        self.total += step
        at = frame % len(self._history), np.arange(len(step))
        self.recent = self.total - self._history[at]  # the ring's oldest entry: the path one window ago
        self._history[at] = self.total
        return self.recent
