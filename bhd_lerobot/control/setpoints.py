"""From a stream of position setpoints to a smooth reference within the limits of speed and acceleration."""

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import PositionLimits

# [1/s] How eagerly a remaining error is closed. A fifth of the highest gain that a second-order filter with one tick of
# delay is stable with at 500 Hz; well above what an arm can follow.
_GAIN = 50.0
# The share of the acceleration limit that approaching a target may count on, so that discrete time leaves room.
_APPROACH = 0.7


class SetpointFilter:
    """Follows setpoints that come once a frame, for n robots.

    Over the frame that follows a setpoint the target moves evenly from where the last setpoint put it to the new one,
    and the reference follows the target: with the target's own speed added, so that a steady motion is followed without
    a lag, and never beyond the limits of position, speed and acceleration. A target out of reach in one frame is
    approached as fast as the limits allow.

    Args:
        limits: the limits.
        n: number of robots.
        control_hz: ticks a second [Hz].
        frame_ticks: ticks in a frame.
    """

    def __init__(self, limits: PositionLimits, n: int, control_hz: int, frame_ticks: int) -> None:
        width = len(limits.names)
        self._lower, self._upper = np.asarray(limits.lower), np.asarray(limits.upper)
        self._speed = np.asarray(limits.velocity)
        self._acceleration = np.asarray(limits.acceleration)
        # [rad/s, m/s] by which a speed changes while a brake's acceleration rises to its limit
        self._ramp = self._acceleration**2 / (2 * np.asarray(limits.jerk))
        self._hz, self._frame_ticks = control_hz, frame_ticks
        self._slowest = -self._speed
        self._hardest = -self._acceleration
        # Farther from an end of the range than this, any speed can be stopped in time.
        room = self._room_for(self._speed)
        self._near_upper, self._near_lower = self._upper - room, self._lower + room
        self._target, self._step = np.zeros((n, width)), np.zeros((n, width))
        self._goal, self._left = np.zeros((n, width)), np.zeros(n, np.int64)
        self.active: NDArray[np.bool_] = np.zeros(n, np.bool_)
        self.limited_position: NDArray[np.bool_] = np.zeros(n, np.bool_)
        self.limited_velocity: NDArray[np.bool_] = np.zeros(n, np.bool_)
        self.limited_acceleration: NDArray[np.bool_] = np.zeros(n, np.bool_)
        self.limited = False  # whether any of them may be set

    def head_for(self, values: NDArray[np.float64], mask: NDArray[np.bool_], position: NDArray[np.float64]) -> None:
        """Head for new setpoints.

        Args:
            values: the setpoints, shape (n, width).
            mask: the robots that they are for, shape (n,).
            position: the reference now, shape (n, width): where the target of a robot starts that had none.
        """
        clipped = np.minimum(np.maximum(values, self._lower), self._upper)
        self.limited = True
        self.limited_position |= mask & (clipped != values).any(axis=1)
        np.copyto(self._target, position, where=(mask & ~self.active)[:, None])
        np.copyto(self._goal, clipped, where=mask[:, None])
        np.copyto(self._step, (clipped - self._target) / self._frame_ticks, where=mask[:, None])
        self._left[mask] = self._frame_ticks
        self.active |= mask

    def drop(self, mask: NDArray[np.bool_]) -> None:
        """Stop following setpoints."""
        self.active &= ~mask

    def run(
        self, position: NDArray[np.float64], velocity: NDArray[np.float64], acceleration: NDArray[np.float64]
    ) -> None:
        """Advance the reference of the robots that follow setpoints by one tick, in place.

        Args:
            position: the reference, shape (n, width).
            velocity: its speed, shape (n, width).
            acceleration: its acceleration, shape (n, width).
        """
        moving = self._left > 0
        np.copyto(self._target, self._target + self._step, where=moving[:, None])
        arrived = self._left == 1
        if arrived.any():
            np.copyto(self._target, self._goal, where=arrived[:, None])  # sums of steps miss it by their rounding
        feed = np.where(moving[:, None], self._step * self._hz, 0.0)
        self._left -= moving
        error = self._target - position
        size = np.abs(error)
        # Faster than this it could not slow down in time to stop at the target.
        closing = np.minimum(_GAIN * size, np.sqrt(2 * _APPROACH * self._acceleration * size))
        wanted = feed + np.copysign(closing, error)
        # Near an end of a range, no faster than what can still be stopped before it.
        if np.count_nonzero((position > self._near_upper) & (wanted > 0)):
            wanted = np.minimum(wanted, self._stoppable(np.maximum(self._upper - position, 0.0)))
        if np.count_nonzero((position < self._near_lower) & (wanted < 0)):
            wanted = np.maximum(wanted, -self._stoppable(np.maximum(position - self._lower, 0.0)))
        speed = np.minimum(np.maximum(wanted, self._slowest), self._speed)
        change = (speed - velocity) * self._hz
        allowed = np.minimum(np.maximum(change, self._hardest), self._acceleration)
        active = self.active[:, None]
        faster, harder = speed != wanted, allowed != change
        if np.count_nonzero(faster) or np.count_nonzero(harder):
            self.limited = True
            self.limited_velocity |= self.active & faster.any(axis=1)
            self.limited_acceleration |= self.active & harder.any(axis=1)
        np.copyto(acceleration, allowed, where=active)
        np.copyto(velocity, velocity + allowed / self._hz, where=active)
        np.copyto(position, position + velocity / self._hz, where=active)

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
        self.active[ids] = False
        self._left[ids] = 0
        for flags in (self.limited_position, self.limited_velocity, self.limited_acceleration):
            flags[ids] = False
