"""What an evaluation keeps of an episode: numbers from its columns, and the line that the robot drew. Pure.

Everything but `wall` follows from the seed: on the lockstep clock the same brain gets the same numbers, to the last
bit, on any number of simulations.
"""

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.control.messages import Limit, Mode, Watchdog
from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.policies.perception.assessment import assess
from bhd_lerobot.rollout.types import Episode

LIMITS = tuple(limit.name.lower() for limit in Limit if limit.name)
WATCHDOGS = tuple(watchdog.name.lower() for watchdog in Watchdog if watchdog.name)


@dataclass(frozen=True)
class JerkMeasure:
    """Which part of the commands jerk is measured of, and how.

    Jerk is the third derivative of a position. Commands that are speeds are differentiated twice and those that are
    positions three times, by differences between frames; of several joints it is the Euclidean length.
    """

    columns: tuple[int, ...]
    order: int
    unit: str
    what: str

    @classmethod
    def of(cls, action_names: Sequence[str], *, is_si: bool = True) -> "JerkMeasure":
        """Return the measure for commands of these names; those of LeRobot's robots are not in SI units.

        A base's is that of its forward speed, a tool's that of its position, an arm's that of its joints without the
        gripper.
        """
        measure = cls._of(action_names)
        return measure if is_si else replace(measure, unit="units/s³")

    @classmethod
    def _of(cls, action_names: Sequence[str]) -> "JerkMeasure":
        index = {name: column for column, name in enumerate(action_names)}
        if "x.vel" in index:
            return cls((index["x.vel"],), 2, "m/s³", "forward speed")
        tool = [index[name] for name in ("tool_x.pos", "tool_y.pos", "tool_z.pos") if name in index]
        if tool:
            return cls(tuple(tool), 3, "m/s³", "tool position")
        joints = [column for name, column in index.items() if name.endswith(".pos") and name != "gripper.pos"]
        return cls(tuple(joints), 3, "rad/s³", "joint positions")

    def lengths(self, applied: NDArray, places: NDArray[np.float64], fps: int) -> NDArray[np.float64]:
        """Return the jerk between frames, shape (frames - order,).

        Args:
            applied: the commands, shape (frames, actions).
            places: of the frames on the grid of time, shape (frames,).
            fps: places in a second [Hz].
        """
        values = applied[:, self.columns].astype(np.float64)
        if len(values) <= self.order or not self.columns:
            return np.zeros(0)
        for _ in range(self.order):
            values = np.diff(values, axis=0) / np.diff(places)[:, None]
            places = (places[1:] + places[:-1]) / 2
        return np.linalg.norm(values, axis=1) * float(fps) ** self.order


@dataclass(frozen=True, kw_only=True)
class EpisodeMetrics:
    """One episode of one brain, in numbers.

    Attributes:
        brain: the brain's name in the evaluation.
        episode: the episode's number.
        seed: the seed of everything that was random in it, but for the brain's own stream, which follows from it.
        success: whether the task was achieved.
        outcome: what ended it: `success`, or the cause of the failure.
        score: between 0 and 1; defined by the task.
        reward: sum of the rewards: the return.
        frames: number of frames.
        length_s: duration [s].
        path_m: length of the line that the base, or the tool, drew from frame to frame [m]; NaN if it is not known.
        jerk_mean: mean jerk of the commanded motion, see `JerkMeasure`; NaN for an episode of a few frames.
        jerk_max: largest jerk of the commanded motion.
        limits: frames in which the safety filter changed the command, by kind of limit.
        watchdogs: frames in which a watchdog noticed something, by kind.
        estops: 1 if an emergency stop was latched in it, else 0.
        faults: 1 if a fault was latched in it, else 0.
        problem: why the brain gave up, as text, if it did and says so.
        details: further numbers of the task.
        perception: how well the brain saw, see `assess`; empty if it does not see for itself.
        initial_state: a digest of the simulator's complete state at the start, the same for all brains; empty without a
            simulator.
        digest: a digest of everything that was commanded and of every state of the physics.
        wall: what was measured on the wall clock: nothing on the lockstep clock.
    """

    brain: str
    episode: int
    seed: int
    success: bool
    outcome: str
    score: float = math.nan
    reward: float
    frames: int
    length_s: float
    path_m: float = math.nan
    jerk_mean: float = math.nan
    jerk_max: float = math.nan
    limits: dict[str, int] = field(default_factory=dict)
    watchdogs: dict[str, int] = field(default_factory=dict)
    estops: int = 0
    faults: int = 0
    problem: str = ""
    details: dict[str, float] = field(default_factory=dict)
    initial_state: str = ""
    digest: str = ""
    perception: dict[str, float] = field(default_factory=dict)
    wall: dict[str, float] = field(default_factory=dict)

    def plain(self) -> dict[str, Any]:
        """Return what does not depend on the wall clock as plain values; the seed as text, as 63 bits need."""
        values = {one.name: getattr(self, one.name) for one in fields(self) if one.name != "wall"}
        return {**values, "seed": str(self.seed)}


@dataclass(frozen=True, kw_only=True)
class EnvironmentMetrics(EpisodeMetrics):
    """One episode of one policy in an environment of LeRobot: only what such an environment returns."""

    task: str
    max_reward: float

    def plain(self) -> dict[str, Any]:
        """Return what the environment returned as plain values; the seed as text, as in the base class."""
        own = ("brain", "episode", "seed", "success", "outcome", "reward", "frames", "length_s", "task", "max_reward")
        return {name: value for name, value in super().plain().items() if name in own}


# What is the same to the last bit when a simulated episode is run again.
_REPEATED = (keys.ACTION, keys.APPLIED_ACTION, keys.PHYSICS_STATE, keys.REWARD)


def measure(brain: str, episode: Episode, track: NDArray[np.float64], jerk: JerkMeasure, fps: int) -> EpisodeMetrics:
    """Return an episode's numbers.

    `track`: where base or tool was at the start of each frame, x, y, z first [m], shape (frames, 3 or more), or empty.
    """
    columns, outcome = episode.columns, episode.outcome
    lengths = jerk.lengths(columns[keys.APPLIED_ACTION], _places(episode, fps), fps)
    modes = columns[keys.MODE]
    return EpisodeMetrics(
        brain=brain,
        episode=episode.spec.index,
        seed=episode.spec.seed,
        success=bool(outcome.success),
        outcome=outcome.event.cause,
        score=float(outcome.score),
        reward=float(columns[keys.REWARD].sum(dtype=np.float64)),
        frames=episode.frames,
        length_s=episode.duration_s(fps),
        path_m=float(np.linalg.norm(np.diff(track[:, :3], axis=0), axis=1).sum()) if len(track) else math.nan,
        jerk_mean=float(lengths.mean()) if len(lengths) else math.nan,
        jerk_max=float(lengths.max()) if len(lengths) else math.nan,
        limits=_flagged(columns[keys.LIMITS], Limit),
        watchdogs=_flagged(columns[keys.WATCHDOG], Watchdog),
        estops=int((modes == Mode.ESTOP).any()),
        faults=int((modes == Mode.FAULT).any()),
        problem="" if outcome.success else str(episode.plan.get("problem") or ""),
        details=dict(outcome.details),
        initial_state=_digest(episode.initial_state) if episode.initial_state.size else "",
        digest=_digest(*(columns[key] for key in _REPEATED if key in columns)),
        perception=assess(episode.plan, episode.scene),
        wall=_wall(episode),
    )


def _places(episode: Episode, fps: int) -> NDArray[np.float64]:
    """Return the places of the frames on the grid of time, of which a robot that is too slow leaves some out."""
    places = np.arange(episode.frames, dtype=np.float64)
    if episode.timing.clock == "lockstep":
        return places
    time_s = episode.columns[keys.TIME]
    return np.maximum.accumulate(np.round((time_s - time_s[0]) * fps) - places) + places


def _wall(episode: Episode) -> dict[str, float]:
    timing = episode.timing
    if timing.clock == "lockstep":
        return {}
    return {
        "inference_p50_s": timing.inference_p50,
        "inference_p99_s": timing.inference_p99,
        "inference_max_s": timing.inference_max,
        "late_frames": timing.late_frames,
        "drops": timing.drops,
        "overruns": timing.overruns,
    }


def _flagged(values: NDArray, kinds: type[Limit] | type[Watchdog]) -> dict[str, int]:
    """Return in how many frames each flag was set."""
    return {kind.name.lower(): int(np.count_nonzero(values & kind.value)) for kind in kinds if kind.name and kind.value}


def _digest(*arrays: NDArray) -> str:
    code = hashlib.blake2b(digest_size=16)
    for array in arrays:
        code.update(str((array.dtype.str, array.shape)).encode())
        code.update(np.ascontiguousarray(array).data)
    return code.hexdigest()
