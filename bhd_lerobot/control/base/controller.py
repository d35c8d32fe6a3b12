"""The controller of bases with two driven wheels."""

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import MobileBase
from bhd_lerobot.control.base import limits as safety
from bhd_lerobot.control.base.collision_monitor import CollisionMonitor
from bhd_lerobot.control.base.diff_drive import DiffDrive
from bhd_lerobot.control.controller import Controller
from bhd_lerobot.control.messages import NANOSECONDS, Limit, Mode, Watchdog
from bhd_lerobot.control.plant import PlantReading
from bhd_lerobot.errors import ConfigError

_REST = 1e-9  # a ramp has arrived when the command is this close to zero
_STALL_CHECKS = 6  # looks at the wheels' progress until one is blocked, or its encoder is
_LEAST_SPEED = 1.0  # [rad/s] a wheel that is to turn slower than this is not judged
_LEAST_TURN = 0.3  # [rad/s] by which wheels and gyroscope may differ: several times what a cheap one drifts


class BaseController(Controller):
    """Twist commands to wheel speeds, for bases with two driven wheels.

    A command is the forward speed [m/s] and the yaw rate [rad/s]; an actuator command is a wheel speed [rad/s], or the
    twist itself for a base whose own controller turns it into those.

    Args:
        body: limits and wheels.
        n: number of bases.
        control_hz: ticks a second [Hz].
        monitor: what keeps them from driving into what their scans show, the first values of the reading's sensors.
        gyro: which of the reading's sensors is the yaw rate of a gyroscope [rad/s]; None if there is none.
        takes: what the plant takes, see `Plant.takes`.

    Raises:
        ConfigError: the wheels cannot turn the base as fast as its velocity limit allows.
    """

    joints = 2

    def __init__(
        self,
        body: MobileBase,
        n: int,
        control_hz: int,
        *,
        monitor: CollisionMonitor | None = None,
        gyro: int | None = None,
        takes: str = "actuators",
    ) -> None:
        limits, drive = body.limits, body.drive
        self._monitor, self._gyro = monitor, gyro
        self.width = width = len(limits.names)
        self.drive = DiffDrive(drive, n)
        self.command = np.zeros((n, width))
        self._wheel_speeds = np.zeros((n, self.joints))
        self._takes_twist = takes == "twist"
        self.actuators = self.command if self._takes_twist else self._wheel_speeds
        self.busy, self.protective_stop = np.zeros(n, np.bool_), np.zeros(n, np.int64)
        self.contact_wrench = np.zeros((n, 0))
        self._servo_gain, self._torque = drive.servo_gain, drive.max_torque
        self._velocity = np.asarray(limits.velocity)
        self._change = np.asarray(limits.acceleration) / control_hz
        self._stop_change = np.asarray(limits.stop_deceleration) / control_hz
        self._largest_error = drive.max_torque / drive.servo_gain
        per_yaw = drive.wheel_separation / 2 / drive.wheel_radius
        fastest = drive.max_wheel_speed / per_yaw
        if limits.velocity[1] > fastest * (1 + 1e-9):
            raise ConfigError(
                f"The limit of {limits.names[1]} is {limits.velocity[1]}; wheels of {drive.max_wheel_speed:g} rad/s at "
                f"the most can turn the base at {fastest:g} rad/s."
            )
        self._target = np.zeros((n, width))
        self._jerk = np.asarray(limits.jerk) / control_hz**2
        self._hard = np.zeros(n, np.bool_)  # brakes as hard as it can
        self._before, self._rate, self._braking = np.zeros((3, n, width))
        self._clipped = np.zeros((n, width))
        self._error, self._beyond = np.zeros((n, self.joints)), np.zeros((n, self.joints), np.bool_)
        self._settled = self._is_clipped = False
        # The sum of 0 * x is 0 if and only if every x is finite; unlike a plain sum it neither overflows nor warns.
        self._flat_target, self._zeros = self._target.reshape(-1), np.zeros(n * width)
        self._limited_velocity = np.zeros((n, width), np.bool_)
        self._limited_change = np.zeros((n, width), np.bool_)
        self._limited_wheels = np.zeros(n, np.bool_)
        self._limited_effort = np.zeros(n, np.bool_)
        self._limited_finite = np.zeros(n, np.bool_)
        self._limited_clearance = np.zeros(n, np.bool_)
        # Of the wheels since the last look at their progress: how far they were to turn, and where they were.
        self._look_ticks = max(1, round(body.stalled_s / _STALL_CHECKS * control_hz))
        # Each robot has its own time for it, counted from its start: an episode does not depend on those beside it.
        self._ticks, self._next_look, self._dt = 0, self._look_ticks, 1 / control_hz
        self._look_at = np.full(n, self._look_ticks)
        self._asked, self._position = np.zeros((n, self.joints)), np.zeros((n, self.joints))
        self._least_turn = _LEAST_SPEED * self._look_ticks / control_hz
        self._stalls = np.zeros((n, self.joints), np.int64)
        # How far the gyroscope states that the bases turned since the last look, and looks that found otherwise.
        self._turned, self._contradictions = np.zeros(n), np.zeros(n, np.int64)
        self._any_stopped = False
        self._wheels = (1.0 / drive.wheel_radius, per_yaw, drive.max_wheel_speed, self._limited_wheels)

    def set_setpoint(self, values: NDArray[np.float64], mask: NDArray[np.bool_]) -> None:
        """Head for new twists, with the normal accelerations."""
        np.copyto(self._target, values, where=mask[:, None])
        self._hard &= ~mask
        self._settled = self._is_clipped = False

    def stop(self, mask: NDArray[np.bool_], cause: Mode) -> None:
        """Head for rest, with the normal decelerations or with those of an emergency stop."""
        hard = cause in (Mode.ESTOP, Mode.FAULT)
        self._target[mask] = 0.0
        self._hard[mask] = hard
        # What is to stop gets no faster meanwhile: an acceleration ends at once, the brake comes gradually.
        np.copyto(self._rate, 0.0, where=mask[:, None] & (self._rate * self.command > 0))
        self._settled = self._is_clipped = False

    def go_back(self, mask: NDArray[np.bool_], actuators: NDArray[np.float64], rate: NDArray[np.float64]) -> None:
        """Make the twist again what the wheels have."""
        twist = actuators if self._takes_twist else self.drive.twist_from_wheels(actuators)
        np.copyto(self.command, twist, where=mask[:, None])
        np.copyto(self._rate, 0.0, where=mask[:, None])

    def run(self, reading: PlantReading) -> None:
        """Advance by one tick."""
        self.drive.update_odometry(reading.position)
        if self._monitor is not None:
            self._watch(reading, self._monitor)
            self._settled = False  # the room that is left changes while commands stand
        if not self._settled:
            self._filter()
        # A servo beyond its torque gives its largest: that is flagged, and the command stays as it is.
        error = np.subtract(self._wheel_speeds, reading.velocity, out=self._error)
        np.abs(error, out=error)
        if np.count_nonzero(np.greater(error, self._largest_error, out=self._beyond)):
            self._limited_effort |= self._beyond.any(axis=1)
        if self._any_stopped:
            self.protective_stop[:] = self._any_stopped = False
        self._asked += self._wheel_speeds
        if self._gyro is not None:
            self._turned += reading.sensors[:, self._gyro]
        self._ticks += 1
        if self._ticks == self._next_look:
            self._look(reading.position)

    def _watch(self, reading: PlantReading, monitor: CollisionMonitor) -> None:
        """Show the monitor the newest scans, from where the bases were when they took them."""
        pose, ranges = self.drive.odometry, reading.sensors[:, : monitor.beams]
        if reading.stamp_ns is None:
            monitor.see(ranges, reading.sensors_ns, pose)
            return
        age = (reading.stamp_ns - reading.sensors_ns) / NANOSECONDS
        forward, turn = self.drive.twist_from_wheels(reading.velocity).T * age
        middle = pose[:, 2] - turn / 2
        then = pose - np.stack([forward * np.cos(middle), forward * np.sin(middle), turn], axis=1)
        monitor.see(ranges, reading.sensors_ns, then, np.rint(age / self._dt).astype(np.int64))

    def _look(self, position: NDArray[np.float64]) -> None:
        """Find bases with a wheel that does not turn as it is commanded to: it is blocked, or its encoder lies."""
        ids = np.flatnonzero(self._look_at == self._ticks)
        asked, turned = self._asked[ids] * self._dt, position[ids] - self._position[ids]
        stalled = (np.abs(asked) > self._least_turn) & (turned * np.sign(asked) < 0.5 * np.abs(asked))
        stalls = (self._stalls[ids] + 1) * stalled
        stalled = (stalls >= _STALL_CHECKS).any(axis=1)
        self.protective_stop[ids] = stalled * int(Watchdog.BLOCKED)
        stalls[stalled] = 0
        self._stalls[ids] = stalls
        if self._gyro is not None:
            self._compare_turns(ids, position)
        self._any_stopped = bool(self.protective_stop.any())
        self._look_again(ids, position)

    def _compare_turns(self, ids: NDArray[np.intp], position: NDArray[np.float64]) -> None:
        """Find bases whose gyroscope and wheels do not agree about how far they turned: one of them lies, or slips."""
        wheels = self.drive.twist_from_wheels(position[ids] - self._position[ids])[:, 1]
        gyro = self._turned[ids] * self._dt
        apart, largest = np.abs(wheels - gyro), np.maximum(np.abs(wheels), np.abs(gyro))
        differ = (apart > _LEAST_TURN * self._look_ticks * self._dt) & (apart > 0.5 * largest)
        contradictions = (self._contradictions[ids] + 1) * differ
        implausible = contradictions >= _STALL_CHECKS
        self.protective_stop[ids[implausible]] = int(Watchdog.PLANT)
        contradictions[implausible] = 0
        self._contradictions[ids] = contradictions

    def _look_again(self, ids: NDArray[np.intp], position: NDArray[np.float64]) -> None:
        """Begin a new period in which the wheels' progress is looked at; `position` has shape (n, joints)."""
        self._asked[ids] = 0.0
        self._turned[ids] = 0.0
        self._position[ids] = position[ids]
        self._look_at[ids] = self._ticks + self._look_ticks
        self._next_look = int(self._look_at.min())

    def _filter(self) -> None:
        """From the targets to the commands applied in this tick, and the wheel speeds that they mean."""
        if not self._is_clipped:
            self._clip()
        target, command, before, flags = self._clipped, self.command, self._before, self._limited_change
        np.copyto(before, command)
        arrived = safety.limit_jerk(
            target, before, self._rate, largest=self._change, jerk=self._jerk, out=command, changed=flags
        )
        other = self._hard  # whose change is not that of the jerk limit
        if np.count_nonzero(other):
            safety.limit_change(target, before, self._stop_change, self._braking, flags)
            np.copyto(command, self._braking, where=other[:, None])
            np.equal(command, target, out=arrived, where=other[:, None])
        # Both ends of a change can be within the wheels' limit and the way between them not: the two dimensions
        # change at different rates.
        forward = command[:, 0].copy()
        limited = safety.limit_wheel_speed(command, *self._wheels)
        if limited:
            other = other | (forward != command[:, 0])
        if np.count_nonzero(other):
            np.subtract(command, before, out=self._rate, where=other[:, None])
        near = None if self._monitor is None else self._monitor.limit(command, before, self.drive.odometry)
        if near is not None:
            self._limited_clearance |= near.any(axis=1)
            limited = True
            self._rate[near] = 0.0  # the next change starts anew: such a large one could not end in time
        self._settled = not limited and np.count_nonzero(arrived) == arrived.size
        self.drive.wheels_from_twist(self.command, self._wheel_speeds)

    def _clip(self) -> None:
        """From the targets to targets within the limits; they stand until there are others."""
        if self._flat_target.dot(self._zeros) != 0.0:
            # Commands are checked when they are sent; a queue in shared memory is written by another process.
            bad = ~np.isfinite(self._target).all(axis=1)
            self._limited_finite |= bad
            self._target[bad] = 0.0
        safety.limit_velocity(self._target, self._velocity, self._clipped, self._limited_velocity)
        safety.limit_wheel_speed(self._clipped, *self._wheels)
        self._is_clipped = True

    def at_rest(self) -> NDArray[np.bool_]:
        """Return whether each base is commanded to be at rest, shape (n,)."""
        return np.asarray((np.abs(self.command) < _REST).all(axis=1))

    def configure(self, ids: NDArray[np.intp], reading: PlantReading) -> None:
        """Start odometry here."""
        self._stalls[ids] = self._contradictions[ids] = 0
        self._look_again(ids, reading.position)
        self.drive.reset_odometry(ids, reading.position[ids])
        if self._monitor is not None:
            self._monitor.forget(ids)  # what it remembers is where odometry was before

    def restart(self, ids: NDArray[np.intp]) -> None:
        """Forget everything about bases that were put somewhere else."""
        for array in (self.command, self._target, self._wheel_speeds, self._rate):
            array[ids] = 0.0
        self._hard[ids] = False
        if self._monitor is not None:
            self._monitor.forget(ids)
        for flags in self._flags():
            flags[ids] = False
        self._settled = self._is_clipped = False

    def take_limits(self) -> NDArray[np.int64]:
        """Return the `Limit` flags raised since the last call, shape (n,), and clear them."""
        limits = (
            self._limited_finite * int(Limit.NON_FINITE)
            + (self._limited_velocity.any(axis=1) | self._limited_wheels) * int(Limit.VELOCITY)
            + self._limited_change.any(axis=1) * int(Limit.ACCELERATION)
            + self._limited_effort * int(Limit.EFFORT)
            + self._limited_clearance * int(Limit.CLEARANCE)
        )
        for flags in self._flags():
            flags[:] = False
        self._settled = self._is_clipped = False  # a limit that still holds is reported again in the next frame
        return limits

    def efforts(self, reading: PlantReading) -> NDArray[np.float64]:
        """Return the torques of the servos [N m], shape (n, joints)."""
        torque = (self._wheel_speeds - reading.velocity) * self._servo_gain
        return np.minimum(np.maximum(torque, -self._torque), self._torque)

    def odometry(self) -> NDArray[np.float64]:
        """Return x [m], y [m] and yaw [rad] since the start, from the encoders, shape (n, 3)."""
        return self.drive.odometry.copy()

    def measured(self, reading: PlantReading) -> NDArray[np.float64]:
        """Return the twist that the wheels' speeds mean, shape (n, 2)."""
        return self.drive.twist_from_wheels(reading.velocity)

    def _flags(self) -> tuple[NDArray[np.bool_], ...]:
        return (
            self._limited_velocity,
            self._limited_change,
            self._limited_wheels,
            self._limited_effort,
            self._limited_finite,
            self._limited_clearance,
        )
