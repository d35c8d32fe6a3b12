"""From a stream of position setpoints to a smooth reference within the limits of speed, acceleration and jerk."""

import math

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Limits
from bhd_lerobot.control.arm.clearance import SetpointClearance
from bhd_lerobot.control.kernels import clamp, kernel, largest_change
from bhd_lerobot.control.messages import Limit

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Counts = NDArray[np.int64]

# [1/s] How eagerly a remaining error is closed. With the jerk limit of a UR5 the first follows random setpoints best:
# less lags, more overshoots. Without a jerk limit it may be twice as much.
_GAIN, _GAIN_AT_ONCE = 25.0, 50.0
# The share of the acceleration limit that approaching a target may count on, so that discrete time leaves room.
_APPROACH = 0.7
_NEVER = np.iinfo(np.int64).max
_VELOCITY, _ACCELERATION, _CLEARANCE = int(Limit.VELOCITY), int(Limit.ACCELERATION), int(Limit.CLEARANCE)


@kernel()
def stoppable(room: float, acceleration: float, ramp: float, hz: float) -> float:
    """Return the largest speed of the next tick that leaves enough room to stop in.

    In continuous time and at once that is the square root of 2 a x. A tick's motion at the full speed makes it a little
    less, and a brake that changes its acceleration gradually a little more: both fit.
    """
    slowing = _APPROACH * acceleration
    half = slowing / (2 * hz)
    tick_by_tick = min(np.sqrt(half * half + 2 * slowing * room) - half, room * hz)
    return min(tick_by_tick, np.sqrt(ramp * ramp + 2 * acceleration * room) - ramp)


@kernel(
    "void(f8[:,::1], f8[:,::1], f8[:,::1], f8[:,::1], i8[::1], b1[::1], i8[::1], f8[:,::1], "
    "f8[::1], f8[::1], f8[::1], f8[::1], f8[::1], f8[::1], f8[::1], f8, f8, f8[:,::1], i8)"
)
def want_speeds(  # noqa: PLR0917
    target: Array,
    goal: Array,
    step: Array,
    feed: Array,
    arrival: Counts,
    active: Mask,
    limits: Counts,
    speed: Array,
    lower: Array,
    upper: Array,
    near_lower: Array,
    near_upper: Array,
    largest: Array,
    acceleration: Array,
    ramp: Array,
    gain: float,
    hz: float,
    position: Array,
    tick: int,
) -> None:
    """Move the targets on, and write the speeds that lead to them, within the limits of speed and position."""
    for sim in range(len(speed)):
        for k in range(len(largest)):
            target[sim, k] += step[sim, k]
            if arrival[sim] == tick:  # sums of steps miss the goal by their rounding
                target[sim, k] = goal[sim, k]
            if active[sim]:
                where, error = position[sim, k], target[sim, k] - position[sim, k]
                # Faster than this it could not slow down in time to stop at the target.
                fast = np.sqrt(2 * _APPROACH * acceleration[k] * abs(error))
                wanted = math.copysign(min(abs(error) * gain, fast), error) + feed[sim, k]
                if wanted > 0.0 and where > near_upper[k]:
                    wanted = min(wanted, stoppable(max(upper[k] - where, 0.0), acceleration[k], ramp[k], hz))
                if wanted < 0.0 and where < near_lower[k]:
                    wanted = max(wanted, -stoppable(max(where - lower[k], 0.0), acceleration[k], ramp[k], hz))
                speed[sim, k] = clamp(wanted, -largest[k], largest[k])
                if speed[sim, k] != wanted:
                    limits[sim] |= _VELOCITY
            if arrival[sim] == tick:
                step[sim, k] = feed[sim, k] = 0.0
        if arrival[sim] == tick:
            arrival[sim] = _NEVER


@kernel("void(f8[:,::1], b1[::1], i8[::1], f8[::1], i8, f8[::1], f8[::1], b1, f8, f8[:,::1], f8[:,::1], f8[:,::1])")
def follow_speeds(  # noqa: PLR0917
    speed: Array,
    active: Mask,
    limits: Counts,
    share: Array,
    dof: int,
    hardest: Array,
    jerk: Array,
    is_gradual: bool,
    hz: float,
    position: Array,
    velocity: Array,
    acceleration: Array,
) -> None:
    """Advance the reference by a tick at the permitted shares of speeds, within the limits of acceleration and jerk."""
    for sim in range(len(speed)):
        if not active[sim]:
            continue
        if share[sim] < 1.0:
            limits[sim] |= _CLEARANCE
        for k in range(len(jerk)):
            wanted = speed[sim, k] * share[sim] if k < dof else speed[sim, k]  # the gripper is free
            change = (wanted - velocity[sim, k]) * hz
            allowed = clamp(change, -hardest[k], hardest[k])
            if allowed != change:
                limits[sim] |= _ACCELERATION
            if is_gradual:  # near to the last one, and small enough to end when the speed is there
                most = largest_change(abs(change) / jerk[k]) * jerk[k]
                allowed = clamp(allowed, -most, most)
                allowed = clamp(allowed, acceleration[sim, k] - jerk[k], acceleration[sim, k] + jerk[k])
            acceleration[sim, k] = allowed
            velocity[sim, k] += allowed / hz
            position[sim, k] += velocity[sim, k] / hz


class SetpointFilter:
    """Follows setpoints that come once a frame, for n robots.

    Over the frame that follows a setpoint the target moves evenly from where the last setpoint put it to the new one,
    and the reference follows the target: with the target's own speed added, so that a steady motion is followed without
    a lag, and never beyond the limits of position, speed, acceleration and jerk. A target out of reach in one frame is
    approached as fast as the limits allow.

    Attributes:
        clearance: what slows an arm down before it comes too near to something; nothing does if None.
        limits: the `Limit` flags raised since they were last cleared, shape (n,).

    Args:
        control_hz: ticks a second [Hz].
        frame_ticks: ticks in a frame.
    """

    def __init__(
        self,
        limits: Limits,
        n: int,
        control_hz: int,
        frame_ticks: int,
        clearance: SetpointClearance | None = None,
    ) -> None:
        width = len(limits.names)
        self._lower, self._upper = np.asarray(limits.lower), np.asarray(limits.upper)
        speed, acceleration = np.asarray(limits.velocity), np.asarray(limits.acceleration)
        # [rad/s, m/s] by which a speed changes while a brake's acceleration rises to its limit
        ramp = acceleration**2 / (2 * np.asarray(limits.jerk))
        jerk = np.asarray(limits.setpoint_jerk) / control_hz  # of an acceleration in a tick [rad/s^2, m/s^2]
        is_gradual = bool((jerk < 2 * acceleration).any())
        self._hz, self._frame_ticks = control_hz, frame_ticks
        # Farther from an end of the range than this, any speed can be stopped in time: more than `stoppable` needs.
        room = 1.01 * (speed / control_hz + speed * (speed / 2 + ramp) / (_APPROACH * acceleration))
        ends = self._lower, self._upper, self._lower + room, self._upper - room
        # Of the frame that has begun; a target that has arrived has a step of 0.
        self._target, self._goal = np.zeros((n, width)), np.zeros((n, width))
        self._step, self._feed = np.zeros((n, width)), np.zeros((n, width))
        self._runs = 0  # ticks so far
        self._arrival = np.full(n, _NEVER)  # the tick in which each target arrives
        self._speed = np.zeros((n, width))  # that is wanted
        self.clearance = clearance
        self.active: Mask = np.zeros(n, np.bool_)
        self.limits: Counts = np.zeros(n, np.int64)
        targets = self._target, self._goal, self._step, self._feed, self._arrival, self.active, self.limits
        gain = min(_GAIN if is_gradual else _GAIN_AT_ONCE, control_hz / 2)  # more would overshoot in a single tick
        self._want = want_speeds.bind(*targets, self._speed, *ends, speed, acceleration, ramp, gain, float(control_hz))
        share, dof = (np.ones(n), 0) if clearance is None else (clearance.share, clearance.dof)
        state = self._speed, self.active, self.limits, share, dof
        self._follow = follow_speeds.bind(*state, acceleration, jerk, is_gradual, float(control_hz))

    def set_setpoint(self, values: NDArray[np.float64], mask: NDArray[np.bool_], position: NDArray[np.float64]) -> None:
        """Head for new setpoints.

        Args:
            values: the setpoints, shape (n, width).
            mask: the robots that they are for, shape (n,).
            position: the reference now, shape (n, width): where the target of a robot starts that had none.
        """
        clipped = np.minimum(np.maximum(values, self._lower), self._upper)
        where = mask[:, None]
        outside = (clipped != values) & where
        if np.count_nonzero(outside):
            self.limits[outside.any(axis=1)] |= int(Limit.POSITION)
        starting = mask > self.active
        if np.count_nonzero(starting):
            np.copyto(self._target, position, where=starting[:, None])
            self.active |= mask
        np.copyto(self._goal, clipped, where=where)
        np.copyto(self._step, (clipped - self._target) / self._frame_ticks, where=where)
        np.multiply(self._step, self._hz, out=self._feed)
        self._arrival[mask] = self._runs + self._frame_ticks
        if self.clearance is not None:
            self.clearance.check_soon(mask)

    def drop(self, mask: NDArray[np.bool_]) -> None:
        """Stop following setpoints."""
        self.active &= ~mask
        if self.clearance is not None and self.clearance.slows:
            self.clearance.release(mask)

    def run(
        self, position: NDArray[np.float64], velocity: NDArray[np.float64], acceleration: NDArray[np.float64]
    ) -> None:
        """Advance the reference of the robots that follow setpoints by one tick, in place.

        Args:
            position: the reference, shape (n, width).
            velocity: its speed, shape (n, width).
            acceleration: its acceleration, shape (n, width).
        """
        self._runs += 1
        self._want(position, self._runs)
        if self.clearance is not None:
            self.clearance.run(self._runs, position, velocity, self._speed, self.active)
        self._follow(position, velocity, acceleration)

    def restart(self, ids: NDArray[np.intp]) -> None:
        """Forget robots that were put somewhere else."""
        self.active[ids] = False
        self._step[ids] = self._feed[ids] = 0.0
        self._arrival[ids] = _NEVER
        if self.clearance is not None:
            self.clearance.restart(ids)
        self.limits[ids] = 0
