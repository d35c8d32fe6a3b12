"""Jerk-limited trajectories sampled at control ticks: to a target, and to rest. Pure: no clock, no state, no plant."""

from dataclasses import dataclass, replace
from functools import cache
from importlib import import_module
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bhd_lerobot.bodies.body import Limits
from bhd_lerobot.control.commands import ResultCode
from bhd_lerobot.errors import VersionError
from bhd_lerobot.versions import check_version

Array = NDArray[np.float64]

MAX_DURATION_S = 120.0  # [s] a trajectory is kept as a list of ticks; a longer one is a mistake in its limits
_SLACK = 1e-9  # [rad or m; also per s, per s^2] what rounding may add to a state
_ROUNDING = 1e-9  # as a share of a speed


@cache
def load_ruckig() -> Any:
    """Return Ruckig, which only arms need: it is imported with the first, and not before its first motion."""
    try:
        check_version("ruckig")
    except VersionError as error:
        raise VersionError(
            f"Arms need Ruckig. {error}. Where there is no wheel, as for 64-bit ARM, that builds it, with a C++ "
            "compiler: apt-get install g++ cmake"
        ) from error
    return import_module("ruckig")


@dataclass(frozen=True)
class PlanFailure:
    """Why there is no trajectory.

    Attributes:
        code: the result that the goal ends in.
        message: what is wrong, as text, with the offending value and the valid ones.
    """

    code: ResultCode
    message: str


@dataclass(frozen=True)
class State:
    """Where a trajectory starts, each of shape (dof,).

    Attributes:
        position: [rad or m].
        velocity: [rad/s or m/s].
        acceleration: [rad/s^2 or m/s^2].
    """

    position: Array
    velocity: Array
    acceleration: Array

    @classmethod
    def of(cls, position: ArrayLike, velocity: ArrayLike, acceleration: ArrayLike) -> Self:
        """Return a copy of a state."""
        return cls(*(np.array(value, np.float64) for value in (position, velocity, acceleration)))

    @classmethod
    def at_rest(cls, position: ArrayLike) -> Self:
        """Return the state that stands still at a position, shape (dof,)."""
        copy = np.array(position, np.float64)
        return cls(copy, np.zeros_like(copy), np.zeros_like(copy))

    def __getitem__(self, dims: slice) -> Self:
        """Return the state of some of the dimensions."""
        return type(self)(self.position[dims], self.velocity[dims], self.acceleration[dims])

    @property
    def moving(self) -> bool:
        """Whether any dimension has a speed or an acceleration."""
        return bool(self.velocity.any() or self.acceleration.any())


@dataclass(frozen=True)
class MotionLimits:
    """What a trajectory has to stay within, one value for each dimension, each of shape (dof,).

    Attributes:
        velocity: largest speed [rad/s or m/s].
        acceleration: largest acceleration [rad/s^2 or m/s^2].
        jerk: largest change of the acceleration [rad/s^3 or m/s^3].
        lower: smallest position [rad or m].
        upper: largest position [rad or m].
    """

    velocity: Array
    acceleration: Array
    jerk: Array
    lower: Array
    upper: Array

    @classmethod
    def of(cls, limits: Limits, *, stop: bool = False) -> Self:
        """Return the limits of normal motion, or those of a stop."""
        acceleration, jerk = (
            (limits.stop_deceleration, limits.stop_jerk) if stop else (limits.acceleration, limits.jerk)
        )
        values = (limits.velocity, acceleration, jerk, limits.lower, limits.upper)
        return cls(*(np.asarray(value, np.float64) for value in values))

    def __getitem__(self, dims: slice) -> Self:
        """Return the limits of some of the dimensions."""
        return type(self)(
            self.velocity[dims], self.acceleration[dims], self.jerk[dims], self.lower[dims], self.upper[dims]
        )

    def scaled(self, velocity: float = 1.0, acceleration: float = 1.0) -> Self:
        """Return limits with the speeds and the accelerations multiplied by factors."""
        return replace(self, velocity=self.velocity * velocity, acceleration=self.acceleration * acceleration)


@dataclass(frozen=True)
class Trajectory:
    """Where every dimension is to be at ticks 1 to T after the start; at rest in the last.

    Attributes:
        position: [rad or m], shape (T, dof).
        velocity: [rad/s or m/s], shape (T, dof).
        acceleration: [rad/s^2 or m/s^2], shape (T, dof).
    """

    position: Array
    velocity: Array
    acceleration: Array

    @property
    def ticks(self) -> int:
        """Number of ticks, at least 1."""
        return len(self.position)

    @property
    def target(self) -> Array:
        """Where it ends, shape (dof,)."""
        return self.position[-1]

    def then(self, other: "Trajectory") -> "Trajectory":
        """Return this trajectory and after it another one, which starts where this one ends."""
        return Trajectory(
            np.concatenate((self.position, other.position)),
            np.concatenate((self.velocity, other.velocity)),
            np.concatenate((self.acceleration, other.acceleration)),
        )

    def beside(self, other: "Trajectory") -> "Trajectory":
        """Return this trajectory and the dimensions of another one behind its own; who arrives first waits."""
        ticks = max(self.ticks, other.ticks)
        rows = [np.minimum(np.arange(ticks), one.ticks - 1) for one in (self, other)]
        return Trajectory(
            np.concatenate((self.position[rows[0]], other.position[rows[1]]), axis=1),
            np.concatenate((self.velocity[rows[0]], other.velocity[rows[1]]), axis=1),
            np.concatenate((self.acceleration[rows[0]], other.acceleration[rows[1]]), axis=1),
        )


def to_target(
    start: State,
    target: ArrayLike,
    limits: MotionLimits,
    hz: int,
    *brake_limits: MotionLimits,
) -> Trajectory | PlanFailure:
    """Return the quickest trajectory to rest at a target on which all dimensions arrive together.

    The start may be any state: what exceeds the limits is first brought within them, as fast as they allow. Where the
    way from a moving start would leave the position limits, the motion is braked first.

    Args:
        target: the end [rad or m], within the position limits, shape (dof,).
        hz: ticks a second [Hz].
        brake_limits: the limits to brake with if gentler ones do not suffice, and those where these do not either;
            `limits` if there are none.
    """
    goal = np.asarray(target, np.float64)
    first = _calculate(start, goal, limits, hz, "Phase")
    if isinstance(first, Trajectory):
        straight = _straight(start, goal, limits, hz)
        if straight is not None and straight.ticks <= first.ticks:
            first = straight
        if _stays_within(first, start, limits):
            return first
    # Rounding may have put a state a hair outside of what Ruckig takes; or it came too close to a position limit.
    gentle, *hard = brake_limits or (limits,)
    brake = to_rest(start, gentle, hz, *hard)
    if isinstance(brake, PlanFailure):
        return first if isinstance(first, PlanFailure) else brake
    second = _calculate(State.at_rest(brake.target), goal, limits, hz, "Phase")
    return brake.then(second) if isinstance(second, Trajectory) else second


def to_rest(
    start: State, limits: MotionLimits, hz: int, brake_limits: MotionLimits | None = None
) -> Trajectory | PlanFailure:
    """Return the trajectory on which each dimension comes to rest as soon as it can.

    A dimension that cannot come to rest before its position limit brakes harder, if it may; otherwise it overshoots the
    limit by as little as its limits allow and comes to rest on it.

    Args:
        limits: the limits; those of a stop if it is urgent.
        hz: ticks a second [Hz].
        brake_limits: the limits to brake with where gentler ones do not suffice; `limits` if None.
    """
    brake = _calculate(start, None, limits, hz, "No")
    if isinstance(brake, PlanFailure) or _stays_within(brake, start, limits):
        return brake
    lower, upper = _bounds(start, limits)
    outside = ((brake.position < lower - _SLACK) | (brake.position > upper + _SLACK)).any(axis=0)
    target = np.where(outside, np.clip(brake.target, lower, upper), brake.target)
    back = _calculate(start, target, limits, hz, "No") if brake_limits is None else to_rest(start, brake_limits, hz)
    if isinstance(back, PlanFailure):
        return brake
    pick = np.flatnonzero(outside)
    both = brake.beside(back)
    dof = len(target)
    columns = np.arange(dof)
    columns[pick] += dof
    return Trajectory(both.position[:, columns], both.velocity[:, columns], both.acceleration[:, columns])


def eased(start: State, jerk: Array, hz: int) -> tuple[Trajectory | None, State]:
    """Return how what speeds a motion up falls to nothing as fast as it rose, and where that ends.

    Args:
        start: as setpoints left it: a command that went the last tick at one speed.
        jerk: largest change of an acceleration [rad/s^3 or m/s^3], shape (dof,).
        hz: ticks a second [Hz].
    """
    rows, state, step = [], start, jerk / hz
    half = 0.5 / hz  # [s] a trajectory's speed is that at the end of a tick
    while (np.abs(state.acceleration) > step)[state.acceleration * state.velocity > 0].any():
        state = State(state.position, state.velocity, _less(state, step))
        velocity = state.velocity + state.acceleration / hz
        state = State(state.position + velocity / hz, velocity, state.acceleration)
        rows.append((state.position, velocity + state.acceleration * half, state.acceleration))
    rest = _less(state, step)
    before = Trajectory(*np.array(rows).swapaxes(0, 1)) if rows else None
    return before, State(state.position, state.velocity + rest * half, rest)


def _less(state: State, step: Array) -> Array:
    """Return accelerations of which those that speed up are less by a step."""
    change = np.where(state.acceleration * state.velocity > 0, np.minimum(np.abs(state.acceleration), step), 0.0)
    return np.asarray(state.acceleration - np.copysign(change, state.acceleration))


def at_once(position: ArrayLike) -> Trajectory:
    """Return the trajectory of one tick that stands still at a position, shape (dof,)."""
    row = np.array(position, np.float64)[None]
    return Trajectory(row, np.zeros_like(row), np.zeros_like(row))


def _bounds(start: State, limits: MotionLimits) -> tuple[Array, Array]:
    """Return the position limits, widened to hold the start."""
    return np.minimum(limits.lower, start.position), np.maximum(limits.upper, start.position)


def _stays_within(trajectory: Trajectory, start: State, limits: MotionLimits) -> bool:
    lower, upper = _bounds(start, limits)
    position = trajectory.position
    return bool((position >= lower - _SLACK).all() and (position <= upper + _SLACK).all())


def _straight(start: State, goal: Array, limits: MotionLimits, hz: int) -> Trajectory | None:
    """Return the quickest trajectory on the straight line to a goal; None if the start does not move along that line.

    Ruckig finds it from rest only: the state of a straight trajectory is off the line by rounding, and the dimensions
    that wait for the slowest then take another way, with larger accelerations.
    """
    way = goal - start.position
    lead = int(np.abs(way).argmax())
    if len(way) == 1 or not start.moving or way[lead] == 0.0:
        return None
    share = way / way[lead]
    one = slice(lead, lead + 1)
    off = (start.velocity - share * start.velocity[lead], start.acceleration - share * start.acceleration[lead])
    if np.abs(off).max() > _SLACK:
        return None
    with np.errstate(divide="ignore"):
        velocity, acceleration, jerk = (
            (limit / np.abs(share)).min(keepdims=True) for limit in (limits.velocity, limits.acceleration, limits.jerk)
        )
    most = replace(limits[one], velocity=velocity, acceleration=acceleration, jerk=jerk)
    along = _calculate(start[one], goal[one], most, hz, "No")
    if isinstance(along, PlanFailure):
        return None
    position = start.position + (along.position - start.position[lead]) * share
    position[-1] = goal
    return Trajectory(position, along.velocity * share, along.acceleration * share)


def _calculate(
    start: State, target: Array | None, limits: MotionLimits, hz: int, synchronization: str
) -> Trajectory | PlanFailure:
    """Let Ruckig calculate a trajectory to a target, or to rest where the target is None."""
    ruckig, dof = load_ruckig(), len(start.position)
    numbers = (start.position, start.velocity, start.acceleration, *(() if target is None else (target,)))
    if not np.isfinite(numbers).all():
        return PlanFailure(ResultCode.PLANNING_FAILED, f"No trajectory from or to what is not finite: {numbers}.")
    request = ruckig.InputParameter(dof)
    request.synchronization = getattr(ruckig.Synchronization, synchronization)
    request.current_position = start.position
    request.current_velocity = start.velocity
    request.current_acceleration = start.acceleration
    request.max_velocity = _top_speed(start, limits)
    request.max_acceleration = limits.acceleration
    request.max_jerk = limits.jerk
    if target is None:
        request.control_interface = ruckig.ControlInterface.Velocity
    else:
        request.target_position = target
    answer = ruckig.Trajectory(dof)
    try:
        code = int(ruckig.Ruckig(dof).calculate(request, answer))
    except (ruckig.RuckigError, ValueError) as error:  # its bindings do not know all of its own results
        return PlanFailure(ResultCode.PLANNING_FAILED, f"No trajectory: {error}")
    if code < 0:
        return PlanFailure(ResultCode.PLANNING_FAILED, f"No trajectory: Ruckig returns {_name_of(code)}.")
    if not answer.duration <= MAX_DURATION_S:
        return PlanFailure(
            ResultCode.PLANNING_FAILED,
            f"The motion would take {answer.duration:.0f} s; {MAX_DURATION_S:g} s is the most. Give it more speed or "
            "more acceleration.",
        )
    trajectory = sample(answer, hz)
    if target is not None:
        trajectory.position[-1] = target
    # What is left of rounding in the last tick.
    trajectory.velocity[-1] = trajectory.acceleration[-1] = 0.0
    return trajectory


def _top_speed(start: State, limits: MotionLimits) -> Array:
    """Return the largest speeds that Ruckig is given, shape (dof,).

    A start whose speed is exactly the limit when its acceleration has fallen to zero, as everywhere on a ramp to the
    limit, is given a hair more: by rounding alone Ruckig 0.19.4 finds a far slower profile from there.
    """
    peak = np.abs(start.velocity + np.copysign(start.acceleration**2 / (2 * limits.jerk), start.acceleration))
    on_it = np.abs(peak - limits.velocity) <= _ROUNDING * limits.velocity
    return np.where(on_it, np.maximum(peak, limits.velocity) * (1 + _ROUNDING), limits.velocity)


def _name_of(code: int) -> str:
    names = load_ruckig().Result.__members__.items()
    return next((name for name, one in names if int(one) == code), str(code))


def sample(answer: Any, hz: int) -> Trajectory:
    """Return what a Ruckig trajectory is at ticks 1 to T; T is the first at or after its end.

    Between two switches the jerk is constant. Each dimension has up to nine such segments: two in which it is brought
    within the limits, and seven to the target. After the last one it stands still.

    Args:
        answer: a trajectory of one section that Ruckig has calculated.
        hz: ticks a second [Hz].
    """
    lengths, states = [], []
    for profile in answer.profiles[0]:
        brake = profile.brake
        lengths.append((*(brake.t if brake.duration > 0 else (0.0, 0.0)), *profile.t))
        states.append(
            (
                (*brake.p, *profile.p),
                (*brake.v, *profile.v[:-1], 0.0),
                (*brake.a, *profile.a[:-1], 0.0),
                (*brake.j, *profile.j, 0.0),
            )
        )
    ends = np.cumsum(lengths, axis=1)
    begins = np.concatenate((np.zeros((len(ends), 1)), ends), axis=1)
    ticks = max(1, int(np.ceil(answer.duration * hz - 1e-6)))
    time = np.arange(1, ticks + 1)[:, None] / hz
    dims = np.arange(len(ends))
    segment = (time[:, :, None] >= ends).sum(axis=2)
    p, v, a, j = (np.asarray(states).transpose(1, 0, 2))[:, dims, segment]
    since = time - begins[dims, segment]
    return Trajectory(p + since * (v + since * (a / 2 + since * j / 6)), v + since * (a + since * j / 2), a + since * j)
