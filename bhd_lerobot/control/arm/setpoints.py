"""From a stream of position setpoints to a smooth reference within the limits of speed, acceleration and jerk."""

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import PositionLimits
from bhd_lerobot.control.arm.clearance import SetpointClearance
from bhd_lerobot.control.kernels import largest_change
from bhd_lerobot.control.messages import Limit

# [1/s] How eagerly a remaining error is closed. With the jerk limit of a UR5 the first follows random setpoints best:
# less lags, more overshoots. Without a jerk limit it may be twice as much.
_GAIN, _GAIN_AT_ONCE = 25.0, 50.0
# The share of the acceleration limit that approaching a target may count on, so that discrete time leaves room.
_APPROACH = 0.7
# Which joints may come near an end of their range is found once in so many ticks.
_LOOK_TICKS = 20
_NEVER = np.iinfo(np.int64).max


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
        limits: PositionLimits,
        n: int,
        control_hz: int,
        frame_ticks: int,
        clearance: SetpointClearance | None = None,
    ) -> None:
        width = len(limits.names)
        self._lower, self._upper = np.asarray(limits.lower), np.asarray(limits.upper)
        self._speed = np.asarray(limits.velocity)
        self._acceleration = np.asarray(limits.acceleration)
        # [rad/s, m/s] by which a speed changes while a brake's acceleration rises to its limit
        self._ramp = self._acceleration**2 / (2 * np.asarray(limits.jerk))
        self._jerk = np.asarray(limits.setpoint_jerk) / control_hz  # of an acceleration in a tick [rad/s^2, m/s^2]
        self._is_gradual = bool((self._jerk < 2 * self._acceleration).any())
        self._gain = _GAIN if self._is_gradual else _GAIN_AT_ONCE
        self._hz, self._frame_ticks = control_hz, frame_ticks
        self._slowest = -self._speed
        self._hardest = -self._acceleration
        self._closing = 2 * _APPROACH * self._acceleration
        # Farther from an end of the range than this, any speed can be stopped in time, also until the next check.
        room = self._room_for(self._speed) + _LOOK_TICKS * self._speed / control_hz
        self._near_upper, self._near_lower = self._upper - room, self._lower + room
        self._next_look = 0
        self._upward, self._downward = np.ones((n, width), np.bool_), np.ones((n, width), np.bool_)
        self._any_upward = self._any_downward = True
        # Of the frame that has begun; a target that has arrived has a step of 0.
        self._target, self._goal = np.zeros((n, width)), np.zeros((n, width))
        self._step, self._feed = np.zeros((n, width)), np.zeros((n, width))
        self._runs = 0  # ticks so far
        self._arrival = np.full(n, _NEVER)  # the tick in which each target arrives
        self._next_arrival = int(_NEVER)
        self._error, self._size, self._wanted, self._work = np.zeros((4, n, width))
        self._flags = np.zeros((n, width), np.bool_)
        self._all_active = False
        self.clearance = clearance
        self.active: NDArray[np.bool_] = np.zeros(n, np.bool_)
        self.limits: NDArray[np.int64] = np.zeros(n, np.int64)

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
            self._all_active = bool(self.active.all())
            self._next_look = self._runs
        np.copyto(self._goal, clipped, where=where)
        np.copyto(self._step, (clipped - self._target) / self._frame_ticks, where=where)
        np.multiply(self._step, self._hz, out=self._feed)
        self._arrival[mask] = self._runs + self._frame_ticks
        self._next_arrival = int(self._arrival.min())
        if self.clearance is not None:
            self.clearance.check_soon(mask)

    def drop(self, mask: NDArray[np.bool_]) -> None:
        """Stop following setpoints."""
        self.active &= ~mask
        self._all_active = False
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
        # This runs a thousand times a second: each call into numpy counts, and none makes a new array.
        error, size, wanted, change = self._error, self._size, self._wanted, self._work
        self._runs += 1
        self._target += self._step
        arriving = self._runs == self._next_arrival
        if arriving:  # sums of steps miss the goal by their rounding
            np.copyto(self._target, self._goal, where=(self._arrival == self._runs)[:, None])
        np.subtract(self._target, position, out=error)
        np.abs(error, out=size)
        # Faster than this it could not slow down in time to stop at the target.
        np.multiply(self._closing, size, out=wanted)
        np.sqrt(wanted, out=wanted)
        np.multiply(size, self._gain, out=size)
        np.minimum(size, wanted, out=wanted)
        np.copysign(wanted, error, out=wanted)
        np.add(wanted, self._feed, out=wanted)
        if arriving:
            self._arrive()
        self._slow_near_ends(position)
        speed = np.maximum(wanted, self._slowest, out=size)
        np.minimum(speed, self._speed, out=speed)
        self._note(Limit.VELOCITY, speed, wanted)
        if self.clearance is not None:
            self._keep_clear(self.clearance, position, velocity, speed)
        np.subtract(speed, velocity, out=change)
        np.multiply(change, self._hz, out=change)
        allowed = np.maximum(change, self._hardest, out=error)
        np.minimum(allowed, self._acceleration, out=allowed)
        self._note(Limit.ACCELERATION, allowed, change)
        if self._is_gradual:
            self._change_gradually(allowed, change, acceleration)
        if self._all_active:
            acceleration[:] = allowed
            velocity += np.divide(allowed, self._hz, out=allowed)
            position += np.divide(velocity, self._hz, out=allowed)
            return
        active = self.active[:, None]
        np.copyto(acceleration, allowed, where=active)
        np.copyto(velocity, velocity + allowed / self._hz, where=active)
        np.copyto(position, position + velocity / self._hz, where=active)

    def _change_gradually(
        self, allowed: NDArray[np.float64], change: NDArray[np.float64], acceleration: NDArray[np.float64]
    ) -> None:
        """Keep accelerations near to those of the last tick, and small enough to end when the speed is there."""
        most = largest_change(np.abs(change) / self._jerk) * self._jerk
        np.minimum(np.maximum(allowed, -most), most, out=allowed)
        np.minimum(np.maximum(allowed, acceleration - self._jerk), acceleration + self._jerk, out=allowed)

    def _keep_clear(
        self,
        clearance: SetpointClearance,
        position: NDArray[np.float64],
        velocity: NDArray[np.float64],
        speed: NDArray[np.float64],
    ) -> None:
        """Want no more than lets an arm stop before it comes too near to something; the gripper is free."""
        clearance.run(self._runs, position, velocity, speed, self.active)
        if clearance.slows:
            speed[:, : clearance.dof] *= clearance.share[:, None]
            self.limits[clearance.share < 1.0] |= int(Limit.CLEARANCE)

    def _arrive(self) -> None:
        arrived = self._arrival == self._runs
        self._step[arrived] = self._feed[arrived] = 0.0
        self._arrival[arrived] = _NEVER
        self._next_arrival = int(self._arrival.min())

    def _slow_near_ends(self, position: NDArray[np.float64]) -> None:
        """Want no more, near an end of a range, than what can still be stopped before it."""
        if self._runs > self._next_look:
            self._next_look = self._runs + _LOOK_TICKS - 1
            self._any_upward = bool(np.greater(position, self._near_upper, out=self._upward).any())
            self._any_downward = bool(np.less(position, self._near_lower, out=self._downward).any())
        wanted, flags = self._wanted, self._flags
        if self._any_upward and np.count_nonzero(np.logical_and(self._upward, wanted > 0, out=flags)):
            np.minimum(wanted, self._stoppable(np.maximum(self._upper - position, 0.0)), out=wanted)
        if self._any_downward and np.count_nonzero(np.logical_and(self._downward, wanted < 0, out=flags)):
            np.maximum(wanted, -self._stoppable(np.maximum(position - self._lower, 0.0)), out=wanted)

    def _note(self, limit: Limit, got: NDArray[np.float64], wanted: NDArray[np.float64]) -> None:
        """Flag the robots that did not get what was wanted."""
        if np.count_nonzero(np.not_equal(got, wanted, out=self._flags)):
            self.limits[self.active & self._flags.any(axis=1)] |= int(limit)

    def _stoppable(self, room: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the largest speed of the next tick that leaves enough room to stop in.

        In continuous time and at once that is the square root of 2 a x. A tick's motion at the full speed makes it a
        little less, and a brake that changes its acceleration gradually a little more: both fit.
        """
        slowing = _APPROACH * self._acceleration
        half = slowing / (2 * self._hz)
        tick_by_tick = np.minimum(np.sqrt(half * half + 2 * slowing * room) - half, room * self._hz)
        gradually = np.sqrt(self._ramp * self._ramp + 2 * self._acceleration * room) - self._ramp
        return np.asarray(np.minimum(tick_by_tick, gradually))

    def _room_for(self, speed: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return how much room is enough to stop from a speed, within a rounding."""
        low, high = np.zeros_like(speed), self._upper - self._lower + speed * speed / self._acceleration + 1.0
        for _ in range(60):
            middle = (low + high) / 2
            enough = self._stoppable(middle) >= speed
            low, high = np.where(enough, low, middle), np.where(enough, middle, high)
        return np.asarray(high)

    def restart(self, ids: NDArray[np.intp]) -> None:
        """Forget robots that were put somewhere else."""
        self.active[ids] = self._all_active = False
        self._step[ids] = self._feed[ids] = 0.0
        self._arrival[ids] = _NEVER
        self._next_arrival = int(self._arrival.min())
        if self.clearance is not None:
            self.clearance.restart(ids)
        self.limits[ids] = 0
