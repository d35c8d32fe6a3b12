"""When a learner needs help: it gets nowhere, is about to hit something, takes too long, or differs from the expert."""

import math
from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import PositionLimits
from bhd_lerobot.bodies.turtlebot3 import turtlebot3_burger
from bhd_lerobot.bodies.ur5 import ur5
from bhd_lerobot.control.geometry.kinematics import ArmKinematics
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.policies.brain import Observation, find_columns, find_scan
from bhd_lerobot.policies.navigation.clearance import HULL, LIDAR_X, WHEELS

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_STALL_RAD, _STALL_M = 0.05, 0.1  # an arm that turns no joint farther, a base that gets no farther, has stalled
_TABLE_ROOM, _SELF_ROOM = 0.001, 0.015  # [m] beyond the least distance that goals keep to
_STOP_POSTURES = 6  # along the way on which an arm comes to rest
_STOP_SHARE = 1.3  # of the way that a stop takes; while it is planned, the arm speeds up for a moment
_ARC_POINTS = 6  # along the way of a base
_BASE_ROOM = 0.005  # [m] beside the outline
_NO_RETURN = 3.49  # [m] a beam that reads more has hit nothing
_BASE, _ARM = turtlebot3_burger(), ur5()
_DOF = len(_ARM.limits.names) - 1


class Watch(Protocol):
    """Checks what a learner does in each frame of its turns."""

    cause: str
    """What it finds, in words."""

    def restart(self, ids: NDArray[np.intp], n: int) -> None:
        """Begin the learner's turn in some of n simulations."""

    def check(self, seen: Observation, wanted: Array, advised: Array | None) -> Mask:
        """Return where the learner needs help, shape (n,).

        To be called once a frame; where the learner does not drive, the answer means nothing.

        Args:
            seen: what the robots see.
            wanted: what the learner wants, shape (n, actions).
            advised: what the expert would do, shape (n, actions); None if the expert gives goals.
        """


class _FrameCounter:
    """Counts frames of the learner's turn in every simulation."""

    def __init__(self) -> None:
        self._frames = np.zeros(0, np.int64)

    def restart(self, ids: NDArray[np.intp], n: int) -> None:
        """Begin the learner's turn."""
        if len(self._frames) != n:
            self._frames = np.zeros(n, np.int64)
        self._frames[ids] = 0


class PatienceWatch(_FrameCounter):
    """The learner has had its time.

    Args:
        frames: how many frames its turn may last.
    """

    cause = "time is up"

    def __init__(self, frames: int) -> None:
        super().__init__()
        self._most = frames

    def check(self, seen: Observation, wanted: Array, advised: Array | None) -> Mask:
        """Count the frames."""
        self._frames += 1
        return np.asarray(self._frames > self._most)


class StallWatch:
    """The robot gets nowhere: no joint turns, or the base stays where it is.

    Args:
        frames: for so many frames.
        names: the observation's features.
        fps: frames a second [Hz].

    Raises:
        ConfigError: these are not the features of a robot that it knows.
    """

    cause = "no progress"

    def __init__(self, frames: int, names: Sequence[str], fps: int) -> None:
        self._window, self._dt = frames + 1, 1.0 / fps
        self._is_base = "x.vel" in names
        wanted = ("x.vel", "theta.vel") if self._is_base else _ARM.limits.names[:-1]
        self._columns = find_columns(names, wanted, "dagger", "observation")
        self._pose: Array = np.zeros((0, 3))
        self._past: Array = np.zeros((0, 0, 0))
        self._frames = np.zeros(0, np.int64)

    def restart(self, ids: NDArray[np.intp], n: int) -> None:
        """Begin the learner's turn."""
        if len(self._frames) != n:
            self._frames, self._pose = np.zeros(n, np.int64), np.zeros((n, 3))
            self._past = np.zeros((n, self._window, 2 if self._is_base else _DOF))
        self._frames[ids] = 0

    def check(self, seen: Observation, wanted: Array, advised: Array | None) -> Mask:
        """Compare where the robot was within the window."""
        values = seen.state[:, self._columns]
        if self._is_base:
            self._pose[:, 2] += values[:, 1] * self._dt
            step = values[:, 0] * self._dt
            self._pose[:, 0] += step * np.cos(self._pose[:, 2])
            self._pose[:, 1] += step * np.sin(self._pose[:, 2])
            values = self._pose[:, :2]
        self._past[np.arange(len(values)), self._frames % self._window] = values
        self._frames += 1
        span = self._past.max(axis=1) - self._past.min(axis=1)
        still = span.max(axis=1) < (_STALL_M / math.sqrt(2) if self._is_base else _STALL_RAD)
        return np.asarray((self._frames >= self._window) & still)


class DisagreementWatch(_FrameCounter):
    """The learner wants something else than the expert would do.

    Args:
        share: by more than this share of an action's range,
        frames: for so many frames in a row.
        names: the action's features.

    Raises:
        ConfigError: the range of an action is not known.
    """

    cause = "disagreement"

    def __init__(self, share: float, frames: int, names: Sequence[str]) -> None:
        self._share, self._most = share, frames
        super().__init__()
        self._range = _ranges(names)

    def check(self, seen: Observation, wanted: Array, advised: Array | None) -> Mask:
        """Count the frames of disagreement."""
        if advised is None:
            raise AssertionError("It is not used with an expert that gives goals.")
        apart = (np.abs(wanted - advised) / self._range).max(axis=1) > self._share
        self._frames = (self._frames + 1) * apart
        return np.asarray(self._frames >= self._most)


class BaseCollisionWatch:
    """What the learner wants would drive the base into what its scan shows.

    Args:
        horizon_s: within this time [s].
        observed: the observation's features.
        actions: the action's features.
    """

    cause = "about to collide"

    def __init__(self, horizon_s: float, observed: Sequence[str], actions: Sequence[str]) -> None:
        self._scan, self._angles = find_scan(observed, "dagger")
        self._twist = find_columns(actions, ("x.vel", "theta.vel"), "dagger", "action")
        self._limit = np.array(_BASE.limits.velocity)
        self._times = horizon_s * np.arange(1, _ARC_POINTS + 1) / _ARC_POINTS

    def restart(self, ids: NDArray[np.intp], n: int) -> None:
        """It remembers nothing."""

    def check(self, seen: Observation, wanted: Array, advised: Array | None) -> Mask:
        """Compare the robot's outline on its way with what the scan shows."""
        ranges = seen.state[:, self._scan]
        is_hit = (ranges > 0) & (ranges < _NO_RETURN)
        x = LIDAR_X + ranges * np.cos(self._angles)
        y = ranges * np.sin(self._angles)
        twist = np.clip(wanted[:, self._twist], -self._limit, self._limit)
        danger = np.zeros(len(ranges), np.bool_)
        for time in self._times:
            angle = twist[:, 1] * time
            # sin(a)/a and (1-cos(a))/a, which are finite where the robot goes straight
            ahead = twist[:, 0] * time * np.sinc(angle / np.pi)
            aside = twist[:, 0] * time * np.sin(angle / 2) * np.sinc(angle / 2 / np.pi)
            cos, sin = np.cos(angle)[:, None], np.sin(angle)[:, None]
            dx, dy = x - ahead[:, None], y - aside[:, None]
            along, across = cos * dx + sin * dy, np.abs(cos * dy - sin * dx)
            for rear, front, half in (HULL, WHEELS):
                inside = (along > rear - _BASE_ROOM) & (along < front + _BASE_ROOM) & (across < half + _BASE_ROOM)
                danger |= (inside & is_hit).any(axis=1)
        return danger


class ArmCollisionWatch:
    """The arm could not come to rest any more before it touches the table or itself.

    Args:
        observed: the observation's features.
        actions: the action's features; if they are not joint positions, only what the arm does now counts.
        fps: frames a second [Hz].
    """

    cause = "about to collide"

    def __init__(self, observed: Sequence[str], actions: Sequence[str], fps: int) -> None:
        joints = _ARM.limits.names[:_DOF]
        self._position = find_columns(observed, joints, "dagger", "observation")
        speeds = [name.replace(".pos", ".vel") for name in joints]
        self._velocity = find_columns(observed, speeds, "dagger", "observation")
        self._actions = find_columns(actions, joints, "dagger", "action") if set(joints) <= set(actions) else None
        self._model, self._fps = ArmKinematics(_ARM.chain, _ARM.limits).collision, fps
        limits = _ARM.limits
        self._speed, self._change = np.array(limits.velocity[:_DOF]), np.array(limits.acceleration[:_DOF])
        self._delay = self._change / np.array(limits.jerk[:_DOF])
        self._least = _ARM.chain.min_distance

    def restart(self, ids: NDArray[np.intp], n: int) -> None:
        """It remembers nothing."""

    def check(self, seen: Observation, wanted: Array, advised: Array | None) -> Mask:
        """Compare the postures on the way to rest with the table and with each other."""
        position, velocity = seen.state[:, self._position], seen.state[:, self._velocity]
        after = velocity
        if self._actions is not None:
            speed = np.clip((wanted[:, self._actions] - position) * self._fps, -self._speed, self._speed)
            change = self._change / self._fps
            after = np.clip(speed, velocity - change, velocity + change)
        frame = (velocity + after) / 2 / self._fps
        way = _STOP_SHARE * (after * self._delay + after * np.abs(after) / (2 * self._change))
        share = (np.arange(1, _STOP_POSTURES + 1) / _STOP_POSTURES)[:, None, None]
        postures = np.concatenate([position[None], position + frame + share * way])
        itself, table = self._model.distances(postures)
        near = (itself < self._least + _SELF_ROOM) | (table < self._least + _TABLE_ROOM)
        # What is near already may go away.
        leaves = (itself[-1] > itself[0]) & (table[-1] >= table[0]) | (table[-1] > table[0]) & (itself[-1] >= itself[0])
        return np.asarray(near.any(axis=0) & ~(near[0] & leaves))


def collision_watch(horizon_s: float, observed: Sequence[str], actions: Sequence[str], fps: int) -> Watch:
    """Return what watches a robot with these features for collisions.

    Raises:
        ConfigError: there is none for such a robot.
    """
    if "x.vel" in actions:
        return BaseCollisionWatch(horizon_s, observed, actions)
    if set(_ARM.limits.names) <= set(observed):
        return ArmCollisionWatch(observed, actions, fps)
    raise ConfigError(
        f"brain.collision_s foresees collisions of a turtlebot3 and of a ur5, not of a robot with the actions "
        f"{', '.join(actions)}. Leave it out: --brain.collision_s=null."
    )


def _ranges(names: Sequence[str]) -> Array:
    for limits in (_BASE.limits, _ARM.limits):
        if tuple(limits.names) == tuple(names):
            if isinstance(limits, PositionLimits):
                return np.array(limits.upper) - np.array(limits.lower)
            return 2 * np.array(limits.velocity)
    raise ConfigError(
        f"brain.disagreement is a share of an action's range, which is not known of {', '.join(names)}. Leave it out, "
        "or drive a turtlebot3, or a ur5 with --robot.action_space=joint."
    )
