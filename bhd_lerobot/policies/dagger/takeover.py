"""When a learner needs help: it gets nowhere, is about to hit something, takes too long, or differs from the expert."""

import math
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Arm, Body, Drive, LidarSpec
from bhd_lerobot.control.geometry.kinematics import ArmKinematics
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.policies.brain import Observation, RobotFeatures, find_columns, find_scan
from bhd_lerobot.policies.navigation.clearance import Footprint

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_STALL_RAD, _STALL_M = 0.05, 0.1  # an arm that turns no joint farther, a base that gets no farther, has stalled
_TABLE_ROOM, _SELF_ROOM = 0.001, 0.015  # [m] beyond the least distance that goals keep to
_STOP_POSTURES = 6  # along the way on which an arm comes to rest
_STOP_SHARE = 1.3  # of the way that a stop takes; while it is planned, the arm speeds up for a moment
_ARC_POINTS = 6  # along the way of a base
_BASE_ROOM = 0.005  # [m] beside the outline
_ROUNDING = 0.01  # [m] a beam that reads its largest range, but for this, has hit nothing
_TWIST = ("x.vel", "theta.vel")


class Watch(Protocol):
    """Checks what a learner does in each frame of its turns."""

    cause: str
    """What it finds, as text."""

    def restart(self, ids: NDArray[np.intp], n: int) -> None:
        """Begin the learner's turn in some of n simulations; what remembers nothing does nothing."""
        return None

    def check(self, seen: Observation, wanted: Array, advised: Array) -> Mask:
        """Return where the learner needs help, shape (n,).

        To be called once a frame; where the learner does not drive, the answer means nothing.

        Args:
            seen: what the robots see.
            wanted: what the learner wants, shape (n, actions).
            advised: what the expert would do, shape (n, actions).
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
    """The learner has driven for `frames` frames."""

    cause = "time is up"

    def __init__(self, frames: int) -> None:
        super().__init__()
        self._most = frames

    def check(self, seen: Observation, wanted: Array, advised: Array) -> Mask:
        """Count the frames."""
        self._frames += 1
        return np.asarray(self._frames > self._most)


class StallWatch:
    """The robot gets nowhere for `frames` frames: no joint turns, or the base stays where it is."""

    cause = "no progress"

    def __init__(self, frames: int, robot: RobotFeatures) -> None:
        self._window, self._dt = frames + 1, 1.0 / robot.fps
        self._is_base = robot.body is not None and robot.body.drive is not None
        has_arm = not self._is_base or (robot.body is not None and robot.body.arm is not None)
        names = (*(_joints_of(robot) if has_arm else ()), *(_TWIST if self._is_base else ()))
        self._columns = find_columns(robot.observation_names, names, "dagger", "observation")
        self._least = np.full(len(names), _STALL_RAD)  # of a base x and y are watched
        self._least[len(names) - 2 * self._is_base :] = _STALL_M / math.sqrt(2)
        self._pose: Array = np.zeros((0, 3))
        self._past: Array = np.zeros((0, 0, 0))
        self._frames = np.zeros(0, np.int64)

    def restart(self, ids: NDArray[np.intp], n: int) -> None:
        """Begin the learner's turn."""
        if len(self._frames) != n:
            self._frames, self._pose = np.zeros(n, np.int64), np.zeros((n, 3))
            self._past = np.zeros((n, self._window, len(self._least)))
        self._frames[ids] = 0

    def check(self, seen: Observation, wanted: Array, advised: Array) -> Mask:
        """Compare where the robot was within the window."""
        values = seen.state[:, self._columns]
        if self._is_base:
            self._pose[:, 2] += values[:, -1] * self._dt
            step = values[:, -2] * self._dt
            self._pose[:, 0] += step * np.cos(self._pose[:, 2])
            self._pose[:, 1] += step * np.sin(self._pose[:, 2])
            values[:, -2:] = self._pose[:, :2]
        self._past[np.arange(len(values)), self._frames % self._window] = values
        self._frames += 1
        span = self._past.max(axis=1) - self._past.min(axis=1)
        still = (span < self._least).all(axis=1)
        return np.asarray((self._frames >= self._window) & still)


class DisagreementWatch(_FrameCounter):
    """For `frames` frames in a row the learner differs from the expert by more than this share of an action's range."""

    cause = "disagreement"

    def __init__(self, share: float, frames: int, robot: RobotFeatures) -> None:
        self._share, self._most = share, frames
        super().__init__()
        limits = None if robot.body is None else robot.body.limits
        if limits is None or tuple(limits.names) != tuple(robot.action_names):
            raise ConfigError(
                "brain.disagreement is a share of an action's range, which is not known of "
                f"{', '.join(robot.action_names)}. Leave it out, or drive a simulated base, or an arm with "
                "--robot.action_space=joint."
            )
        lower, upper = limits.bounds
        self._range = np.array(upper) - np.array(lower)

    def check(self, seen: Observation, wanted: Array, advised: Array) -> Mask:
        """Count the frames of disagreement."""
        apart = (np.abs(wanted - advised) / self._range).max(axis=1) > self._share
        self._frames = (self._frames + 1) * apart
        return np.asarray(self._frames >= self._most)


class BaseCollisionWatch(Watch):
    """What the learner wants would drive the base within `horizon_s` [s] into what its scan shows."""

    cause = "about to collide"

    def __init__(self, horizon_s: float, robot: RobotFeatures, body: Body) -> None:
        self._scan, self._angles = find_scan(robot.observation_names, "dagger")
        self._twist = find_columns(robot.action_names, _TWIST, "dagger", "action")
        self._limit = np.array(body.need(Drive).limits.velocity)
        self._footprint, self._no_return = Footprint.of(body), body.need(LidarSpec).range_max - _ROUNDING
        self._times = horizon_s * np.arange(1, _ARC_POINTS + 1) / _ARC_POINTS

    def check(self, seen: Observation, wanted: Array, advised: Array) -> Mask:
        """Compare the robot's outline on its way with what the scan shows."""
        ranges = seen.state[:, self._scan]
        is_hit = (ranges > 0) & (ranges < self._no_return)
        x = self._footprint.lidar_x + ranges * np.cos(self._angles)
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
            for rear, front, half in self._footprint.outline:
                inside = (along > rear - _BASE_ROOM) & (along < front + _BASE_ROOM) & (across < half + _BASE_ROOM)
                danger |= (inside & is_hit).any(axis=1)
        return danger


class ArmCollisionWatch(Watch):
    """The arm could not come to rest any more before it touches the table or itself.

    If the robot's actions are not joint positions, only what the arm does now counts.
    """

    cause = "about to collide"

    def __init__(self, robot: RobotFeatures, arm: Arm) -> None:
        limits, dof = arm.limits, len(arm.chain.joints)
        joints, actions = limits.names[:dof], robot.action_names
        self._position = find_columns(robot.observation_names, joints, "dagger", "observation")
        speeds = [name.replace(".pos", ".vel") for name in joints]
        self._velocity = find_columns(robot.observation_names, speeds, "dagger", "observation")
        self._actions = find_columns(actions, joints, "dagger", "action") if set(joints) <= set(actions) else None
        self._model, self._fps = ArmKinematics(arm.chain, limits).collision, robot.fps
        self._speed, self._change = np.array(limits.velocity[:dof]), np.array(limits.acceleration[:dof])
        self._delay = self._change / np.array(limits.jerk[:dof])
        self._least = arm.chain.min_distance

    def check(self, seen: Observation, wanted: Array, advised: Array) -> Mask:
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


class BothWatch(Watch):
    """Either of two things that are about to happen."""

    cause = "about to collide"

    def __init__(self, one: Watch, other: Watch) -> None:
        self._both = one, other

    def check(self, seen: Observation, wanted: Array, advised: Array) -> Mask:
        """Return where one of them is."""
        one, other = (watch.check(seen, wanted, advised) for watch in self._both)
        return one | other


def collision_watch(horizon_s: float, robot: RobotFeatures) -> Watch:
    """Return what watches a robot for collisions."""
    body = robot.body
    base = arm = None
    if body is not None and body.drive is not None and body.lidar is not None:
        base = BaseCollisionWatch(horizon_s, robot, body)
    if body is not None and body.arm is not None:
        arm = ArmCollisionWatch(robot, body.arm)
    if base and arm:
        return BothWatch(base, arm)
    if one := base or arm:
        return one
    raise ConfigError(
        "brain.collision_s foresees collisions of simulated arms and of simulated bases with a lidar, not of a robot "
        f"with the actions {', '.join(robot.action_names)}. Leave it out: --brain.collision_s=null."
    )


def _joints_of(robot: RobotFeatures) -> tuple[str, ...]:
    if robot.body is None:
        raise ConfigError(
            "brain.stall_s needs a robot whose joints are known: a simulated one. Leave it out: --brain.stall_s=null."
        )
    return robot.body.limits.names[: len(robot.body.need(Arm).chain.joints)]
