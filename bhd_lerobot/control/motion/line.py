"""Moves the tool along a straight line, its orientation turning evenly, within the joints' limits and the tool's."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from bhd_lerobot.control.commands import ResultCode
from bhd_lerobot.control.geometry.kinematics import ArmKinematics
from bhd_lerobot.control.motion.path_timing import PathLimits, PathTimer, PathTiming, follow
from bhd_lerobot.control.motion.trajectory import (
    MAX_DURATION_S,
    MotionLimits,
    PlanFailure,
    State,
    Trajectory,
    at_once,
    to_target,
)

Array = NDArray[np.float64]

_STEP = 0.004  # [m] distance of the poses that the first spline goes through
_TURN = 0.03  # [rad] and the angle between them
_DEVIATION = 2e-5  # [m] a spline that leaves the line by more gets twice as many poses
_MOST_POSES = 4000
_GOOD = 1.15  # times the shortest duration there is without limits of the jerk: a law that is not worth improving
_FURTHER = 1.0005  # ticks fall elsewhere on a slower law
_NO_MOTION = 1e-9  # [m and rad] a line shorter than this is none


@dataclass(frozen=True)
class Line:
    """A straight way of the tool.

    Attributes:
        start: the pose it starts at, in the base frame, shape (4, 4).
        goal: the pose it ends at, in the base frame, shape (4, 4).
    """

    start: Array
    goal: Array

    @property
    def length(self) -> float:
        """How far the tool centre point goes [m]."""
        return float(np.linalg.norm(self.goal[:3, 3] - self.start[:3, 3]))

    @cached_property
    def turn(self) -> Array:
        """Axis times angle from the first orientation to the last, in the first tool frame [rad], shape (3,)."""
        return np.asarray(Rotation.from_matrix(self.start[:3, :3].T @ self.goal[:3, :3]).as_rotvec())

    def poses(self, share: Array) -> Array:
        """Return the poses after shares of the way of shape (K,), 0 to 1, shape (K, 4, 4)."""
        poses = np.tile(self.start, (len(share), 1, 1))
        poses[:, :3, 3] += share[:, None] * (self.goal[:3, 3] - self.start[:3, 3])
        poses[:, :3, :3] = self.start[:3, :3] @ Rotation.from_rotvec(share[:, None] * self.turn).as_matrix()
        return poses


@dataclass(frozen=True)
class ToolLimits:
    """How fast the tool centre point may be on a line.

    Attributes:
        velocity: [m/s].
        acceleration: [m/s^2].
    """

    velocity: float
    acceleration: float

    def least_s(self, length: float) -> float:
        """Return the time that a line of this length takes at least, from rest to rest [s]."""
        if length * self.acceleration < self.velocity**2:
            return float(2 * np.sqrt(length / self.acceleration))
        return length / self.velocity + self.velocity / self.acceleration


def along_line(
    posture: Array, goal: Array, kinematics: ArmKinematics, limits: tuple[MotionLimits, ToolLimits], hz: int
) -> Trajectory | PlanFailure:
    """Return the trajectory that moves the tool from rest to rest on the straight line to a pose.

    The way is a spline in joint space through postures that lie on the line; one jerk-limited law of time for all
    joints runs along it, as fast as the limits allow where they are tightest.

    Args:
        posture: the start [rad], shape (dof,).
        goal: tool pose in the base frame, shape (4, 4).
        hz: ticks a second [Hz].
    """
    line = Line(kinematics.tool(posture), goal)
    angle = float(np.linalg.norm(line.turn))
    if max(line.length, angle) < _NO_MOTION:
        return at_once(posture)
    steps = max(8, int(np.ceil(max(line.length / _STEP, angle / _TURN))))
    while True:
        share: Array = np.linspace(0.0, 1.0, steps + 1, dtype=np.float64)
        way = kinematics.line(line.poses(share), posture)
        if way.code != ResultCode.SUCCEEDED:
            return PlanFailure(way.code, f"The line cannot be followed: {way.message}")
        way.postures[0] = posture  # the closed form returns it with rounding
        spline = CubicSpline(share, way.postures)
        between = share[:-1] + 0.5 / steps
        error = np.subtract(kinematics.tool(spline(between)), line.poses(between))[:, :3, 3]
        deviation = float(np.linalg.norm(error, axis=1).max())
        if deviation < _DEVIATION:
            return _timed(spline, line.length, limits, hz)
        steps *= 2
        if steps > _MOST_POSES:
            return PlanFailure(
                ResultCode.SINGULAR,
                f"The line comes so close to a singular posture that {steps // 2} postures leave the tool "
                f"{deviation * 1e3:.3g} mm beside it; at most {_DEVIATION * 1e3:g} mm are permitted.",
            )


def _timed(
    spline: CubicSpline, length: float, limits: tuple[MotionLimits, ToolLimits], hz: int
) -> Trajectory | PlanFailure:
    """Run along a spline over shares of the way, 0 to 1, as fast as the limits permit.

    One law with the same limits on the whole way is found at once, and good enough where the tool limits it. Where the
    joints do, it is as slow everywhere as they are where they are slowest; then the law follows what they permit.
    """
    even = _evenly(spline, length, limits, hz)
    even_ticks = even.ticks if isinstance(even, Trajectory) else np.inf
    joints, tool = limits
    if even_ticks <= _GOOD * tool.least_s(length) * hz:
        return even
    # The tool is one joint more, which moves evenly.
    path = CubicSpline(spline.x, np.column_stack((spline(spline.x), spline.x * length)))
    own = PathLimits(
        np.append(joints.velocity, tool.velocity),
        np.append(joints.acceleration, tool.acceleration),
        np.append(joints.jerk, np.inf),
    )
    timer = PathTimer(path, own)
    bound = timer.bound()
    if bound is None or bound > MAX_DURATION_S or even_ticks <= _GOOD * bound * hz:
        return even
    timing = timer.find()
    quick = None if timing is None else _sampled(path, timing, own, hz)
    if quick is None or quick.ticks > MAX_DURATION_S * hz or even_ticks <= quick.ticks:
        return even
    return quick


def _sampled(path: CubicSpline, timing: PathTiming, limits: PathLimits, hz: int) -> Trajectory | None:
    """Return the joints at ticks; the law becomes as much slower as its limits need between its nodes."""
    slower = 1.0
    for _ in range(10):
        if timing.duration * slower > MAX_DURATION_S:
            return None
        ticks = int(np.ceil(timing.duration * slower * hz))
        times = np.minimum(np.arange(1, ticks + 1) / hz / slower, timing.duration)
        position, velocity, acceleration, _ = follow(path, timing.share, times)
        velocity, acceleration = velocity / slower, acceleration / slower**2
        position[-1], velocity[-1], acceleration[-1] = path(1.0), 0.0, 0.0
        jerks = np.diff(acceleration, axis=0, prepend=0.0) * hz
        more = _excess(velocity, acceleration, jerks, limits)
        if more <= 1.0:
            return Trajectory(position[:, :-1], velocity[:, :-1], acceleration[:, :-1])
        slower *= more * _FURTHER
    return None


def _excess(velocity: Array, acceleration: Array, jerks: Array, limits: PathLimits | MotionLimits) -> float:
    """Return by which factor a motion has to be slower to keep the limits."""
    return max(
        float((np.abs(velocity) / limits.velocity).max()),
        float(np.sqrt((np.abs(acceleration) / limits.acceleration).max())),
        float(np.cbrt((np.abs(jerks) / limits.jerk).max())),
    )


def _evenly(
    spline: CubicSpline, length: float, limits: tuple[MotionLimits, ToolLimits], hz: int
) -> Trajectory | PlanFailure:
    """Run along a spline as one law of time permits that has the same limits on the whole way."""
    joints, tool = limits
    slope, bend, twist = (np.abs(spline(spline.x, order)) + 1e-12 for order in (1, 2, 3))
    # A first guess, from a share of the limits for each of the terms that add up; scaled below.
    speed = min(
        float((joints.velocity / slope).min()),
        float(np.sqrt(0.5 * joints.acceleration / bend).min()),
        float(np.cbrt(0.3 * joints.jerk / twist).min()),
    )
    change = float((0.6 * joints.acceleration / slope).min())
    if length > 0:
        speed, change = min(speed, tool.velocity / length), min(change, tool.acceleration / length)
    jerk = float((0.6 * joints.jerk / slope).min())
    end = np.array([1.0])
    for _ in range(10):
        law_limits = MotionLimits(*(np.array([value]) for value in (speed, change, jerk, 0.0, 1.0)))
        law = to_target(State.at_rest([0.0]), end, law_limits, hz)
        if isinstance(law, PlanFailure):
            return law
        share, rate, rate_change = np.clip(law.position, 0.0, 1.0), law.velocity, law.acceleration
        first, second = spline(share[:, 0], 1), spline(share[:, 0], 2)
        trajectory = Trajectory(spline(share[:, 0]), first * rate, second * rate * rate + first * rate_change)
        jerks = np.diff(trajectory.acceleration, axis=0, prepend=0.0) * hz
        slower = _excess(trajectory.velocity, trajectory.acceleration, jerks, joints)
        if slower <= 1.0:
            return trajectory
        slower *= _FURTHER
        speed, change, jerk = speed / slower, change / slower**2, jerk / slower**3
    return PlanFailure(ResultCode.PLANNING_FAILED, "No law of time keeps the line within the joints' limits.")
