"""The controller of bases with two driven wheels."""

from functools import partial

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import MobileBase
from bhd_lerobot.control.base.collision_monitor import CollisionMonitor
from bhd_lerobot.control.base.diff_drive import DiffDrive, wheels_from_twist
from bhd_lerobot.control.base.limits import limit_command
from bhd_lerobot.control.controller import Controller
from bhd_lerobot.control.kernels import kernel
from bhd_lerobot.control.messages import NANOSECONDS, Limit, Mode, Watchdog
from bhd_lerobot.control.plant import PlantReading
from bhd_lerobot.errors import ConfigError

_REST = 1e-9  # a ramp has arrived when the command is this close to zero
_STALL_CHECKS = 6  # looks at the wheels' progress until one is blocked, or its encoder is
_LEAST_SPEED = 1.0  # [rad/s] a wheel that is to turn slower than this is not judged
_LEAST_TURN = 0.3  # [rad/s] by which wheels and gyroscope may differ: several times what a cheap one drifts
_BLOCKED, _IMPLAUSIBLE = int(Watchdog.BLOCKED), int(Watchdog.PLANT)

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Counts = NDArray[np.int64]


@kernel(
    "void(f8[:,::1], f8[:,::1], f8[:,::1], f8[:,::1], f8[::1], i8[:,::1], i8[::1], i8[::1], b1[::1], i8[::1], "
    "f8, f8, f8, f8, f8, i8, i8, f8[:,::1], f8[:,::1], f8[:,::1], i8)"
)
def drive_wheels(
    command: Array,
    wheels: Array,
    start: Array,
    asked: Array,
    turned: Array,
    stalls: Counts,
    contradictions: Counts,
    look_at: Counts,
    limited_effort: Mask,
    protective_stop: Counts,
    per_speed: float,
    per_yaw: float,
    yaw_per_turn: float,
    largest_error: float,
    hz: float,
    period: int,
    gyro: int,
    position: Array,
    velocity: Array,
    sensors: Array,
    ticks: int,
) -> None:
    """Go from commands to wheel speeds, and each `period` compare how the wheels turned with them and a gyroscope."""
    wheels_from_twist(command, per_speed, per_yaw, wheels)
    dt, least_way = 1.0 / hz, _LEAST_SPEED * period / hz
    for sim in range(len(command)):
        protective_stop[sim] = 0
        for k in range(2):
            # A servo beyond its torque gives its largest: that is flagged, and the command stays as it is.
            limited_effort[sim] |= abs(wheels[sim, k] - velocity[sim, k]) > largest_error
            asked[sim, k] += wheels[sim, k]
        if gyro >= 0:
            turned[sim] += sensors[sim, gyro]
        if look_at[sim] != ticks:
            continue
        # A wheel that does not turn as it is commanded to: it is blocked, or its encoder lies.
        for k in range(2):
            way, done = asked[sim, k] * dt, position[sim, k] - start[sim, k]
            is_slow = abs(way) > least_way and (done if way > 0.0 else -done) < 0.5 * abs(way)
            stalls[sim, k] = stalls[sim, k] + 1 if is_slow else 0
        if max(stalls[sim, 0], stalls[sim, 1]) >= _STALL_CHECKS:
            protective_stop[sim], stalls[sim, 0], stalls[sim, 1] = _BLOCKED, 0, 0
        if gyro >= 0:
            # Wheels and gyroscope that do not agree about how far the base turned: one of them lies, or slips.
            yaw = ((position[sim, 1] - start[sim, 1]) - (position[sim, 0] - start[sim, 0])) * yaw_per_turn
            apart, largest = abs(yaw - turned[sim] * dt), max(abs(yaw), abs(turned[sim] * dt))
            is_apart = apart > _LEAST_TURN * period * dt and apart > 0.5 * largest
            contradictions[sim] = contradictions[sim] + 1 if is_apart else 0
            if contradictions[sim] >= _STALL_CHECKS:
                protective_stop[sim], contradictions[sim] = _IMPLAUSIBLE, 0
        turned[sim], look_at[sim] = 0.0, ticks + period
        for k in range(2):
            asked[sim, k], start[sim, k] = 0.0, position[sim, k]


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
        per_yaw = drive.wheel_separation / 2 / drive.wheel_radius
        fastest = drive.max_wheel_speed / per_yaw
        if limits.velocity[1] > fastest * (1 + 1e-9):
            raise ConfigError(
                f"The limit of {limits.names[1]} is {limits.velocity[1]}; wheels of {drive.max_wheel_speed:g} rad/s at "
                f"the most can turn the base at {fastest:g} rad/s."
            )
        self._target, self._before, self._rate = np.zeros((3, n, width))
        self._hard = np.zeros(n, np.bool_)  # brakes as hard as it can
        self._limited_velocity, self._limited_change = np.zeros((2, n, width), np.bool_)
        self._not_finite, self._limited_wheels, self._limited_effort, self._limited_clearance = np.zeros(
            (4, n), np.bool_
        )
        # Of the wheels since the last look at their progress: how far they were to turn, and where they were.
        self._period = max(1, round(body.stalled_s / _STALL_CHECKS * control_hz))
        # Each robot has its own time for it, counted from its start: an episode does not depend on those beside it.
        self._ticks, self._dt, self._look_at = 0, 1 / control_hz, np.full(n, self._period)
        self._asked, self._start = np.zeros((2, n, self.joints))
        self._stalls = np.zeros((n, self.joints), np.int64)
        # How far the gyroscope states that the bases turned since the last look, and looks that found otherwise.
        self._turned, self._contradictions = np.zeros(n), np.zeros(n, np.int64)
        per_speed = 1.0 / drive.wheel_radius
        self._limit = partial(
            limit_command.compiled,
            self._target,
            self.command,
            self._before,
            self._rate,
            self._hard,
            np.zeros((n, width)),
            np.asarray(limits.velocity),
            np.asarray(limits.acceleration) / control_hz,
            np.tile(np.asarray(limits.stop_deceleration) / control_hz, (n, 1)),
            np.asarray(limits.jerk) / control_hz**2,
            per_speed,
            per_yaw,
            drive.max_wheel_speed,
            self._not_finite,
            self._limited_velocity,
            self._limited_change,
            self._limited_wheels,
        )
        self._drive_wheels = partial(
            drive_wheels.compiled,
            self.command,
            self._wheel_speeds,
            self._start,
            self._asked,
            self._turned,
            self._stalls,
            self._contradictions,
            self._look_at,
            self._limited_effort,
            self.protective_stop,
            per_speed,
            per_yaw,
            drive.wheel_radius / drive.wheel_separation,
            drive.max_torque / drive.servo_gain,
            float(control_hz),
            self._period,
            -1 if gyro is None else gyro,
        )

    def set_setpoint(self, values: Array, mask: Mask) -> None:
        """Head for new twists, with the normal accelerations."""
        np.copyto(self._target, values, where=mask[:, None])
        self._hard &= ~mask

    def stop(self, mask: Mask, cause: Mode) -> None:
        """Head for rest, with the normal decelerations or with those of an emergency stop."""
        hard = cause in (Mode.ESTOP, Mode.FAULT)
        self._target[mask] = 0.0
        self._hard[mask] = hard
        # What is to stop gets no faster meanwhile: an acceleration ends at once, the brake comes gradually.
        np.copyto(self._rate, 0.0, where=mask[:, None] & (self._rate * self.command > 0))

    def go_back(self, mask: Mask, actuators: Array, rate: Array) -> None:
        """Make the twist again what the wheels have."""
        twist = actuators if self._takes_twist else self.drive.twist_from_wheels(actuators)
        np.copyto(self.command, twist, where=mask[:, None])
        np.copyto(self._rate, 0.0, where=mask[:, None])

    def run(self, reading: PlantReading) -> None:
        """Advance by one tick."""
        self.drive.update_odometry(reading.position)
        self._limit()
        if self._monitor is not None:
            self._watch(reading, self._monitor)
            near = self._monitor.limit(self.command, self._before, self.drive.odometry)
            if near is not None:
                self._limited_clearance |= near.any(axis=1)
                self._rate[near] = 0.0  # the next change starts anew: such a large one could not end in time
        self._ticks += 1
        self._drive_wheels(reading.position, reading.velocity, reading.sensors, self._ticks)

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

    def at_rest(self) -> Mask:
        """Return whether each base is commanded to be at rest, shape (n,)."""
        return np.asarray((np.abs(self.command) < _REST).all(axis=1))

    def configure(self, ids: NDArray[np.intp], reading: PlantReading) -> None:
        """Start odometry here."""
        self._stalls[ids] = self._contradictions[ids] = 0
        self._asked[ids], self._turned[ids], self._start[ids] = 0.0, 0.0, reading.position[ids]
        self._look_at[ids] = self._ticks + self._period
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

    def take_limits(self) -> Counts:
        """Return the `Limit` flags raised since the last call, shape (n,), and clear them."""
        limits = (
            self._not_finite * int(Limit.NON_FINITE)
            + (self._limited_velocity.any(axis=1) | self._limited_wheels) * int(Limit.VELOCITY)
            + self._limited_change.any(axis=1) * int(Limit.ACCELERATION)
            + self._limited_effort * int(Limit.EFFORT)
            + self._limited_clearance * int(Limit.CLEARANCE)
        )
        for flags in self._flags():
            flags[:] = False
        return limits

    def efforts(self, reading: PlantReading) -> Array:
        """Return the torques of the servos [N m], shape (n, joints)."""
        torque = (self._wheel_speeds - reading.velocity) * self._servo_gain
        return np.minimum(np.maximum(torque, -self._torque), self._torque)

    def odometry(self) -> Array:
        """Return x [m], y [m] and yaw [rad] since the start, from the encoders, shape (n, 3)."""
        return self.drive.odometry.copy()

    def measured(self, reading: PlantReading) -> Array:
        """Return the twist that the wheels' speeds mean, shape (n, 2)."""
        return self.drive.twist_from_wheels(reading.velocity)

    def _flags(self) -> tuple[Mask, ...]:
        return (
            self._limited_velocity,
            self._limited_change,
            self._limited_wheels,
            self._limited_effort,
            self._not_finite,
            self._limited_clearance,
        )
