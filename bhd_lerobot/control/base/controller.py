"""The controller of bases with two driven wheels."""

import math

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Drive
from bhd_lerobot.control.base.collision_monitor import CollisionMonitor
from bhd_lerobot.control.base.diff_drive import DiffDrive, wheels_from_twist
from bhd_lerobot.control.base.limits import limit_command
from bhd_lerobot.control.controller import Controller
from bhd_lerobot.control.kernels import kernel
from bhd_lerobot.control.messages import NANOSECONDS, Limit, Mode, Watchdog
from bhd_lerobot.control.plant import PlantReading
from bhd_lerobot.errors import ConfigError

_REST = 1e-9  # a ramp has arrived when the command is this close to zero
_LOOKS = 6  # looks at the wheels' progress until one is blocked, or its encoder is
_LEAST_SPEED = 1.0  # [rad/s] a wheel that is to turn slower than this is not judged
_STANDS_RAD = 0.02  # a wheel that turned less has not moved
_LEAST_TURN = 0.3  # [rad/s] by which wheels and gyroscope may differ: several times what a cheap one drifts
_BLOCKED, _IMPLAUSIBLE, _EFFORT = int(Watchdog.BLOCKED), int(Watchdog.PLANT), int(Limit.EFFORT)

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Counts = NDArray[np.int64]


@kernel(
    "void(f8[:,::1], f8[:,::1], f8[:,::1], f8[:,::1], f8[::1], i8[:,::1], i8[:,::1], f8[:,:,::1], i8[::1], i8[::1], "
    "f8[::1], i8, i8, f8[:,::1], f8[:,::1], f8[:,::1], i8[::1], i8)"
)
def drive_wheels(  # noqa: PLR0917
    command: Array,
    wheels: Array,
    start: Array,
    asked: Array,
    turned: Array,
    looks: Counts,
    look_at: Counts,
    late: Array,
    limits: Counts,
    protective_stop: Counts,
    numbers: Array,
    period: int,
    gyro: int,
    position: Array,
    velocity: Array,
    sensors: Array,
    stamp_ns: Counts,
    ticks: int,
) -> None:
    """Go from commands to wheel speeds, and each `period` compare how the wheels turned with them and a gyroscope.

    `looks` counts, of the two wheels and the gyroscope, the looks that found them wrong, shape (n, 3). `look_at` is the
    tick of the next look, that of the last one, and the stamp of the reading then, shape (n, 3). `late` are the speeds
    that were commanded from one look to the next, as far back as the robot's latency, shape (n, 2, looks).
    """
    per_speed, per_yaw, yaw_per_turn, largest_error, hz = numbers[0], numbers[1], numbers[2], numbers[3], numbers[4]
    wheels_from_twist(command, per_speed, per_yaw, wheels)
    dt = 1.0 / hz
    for sim in range(len(command)):
        protective_stop[sim] = 0
        for k in range(2):
            # A servo beyond its torque gives its largest: that is flagged, and the command stays as it is.
            if abs(wheels[sim, k] - velocity[sim, k]) > largest_error:
                limits[sim] |= _EFFORT
            asked[sim, k] += wheels[sim, k]
        if gyro >= 0:
            turned[sim] += sensors[sim, gyro]
        if ticks < look_at[sim, 0] or stamp_ns[sim] == look_at[sim, 2]:
            continue  # what has not been read again says nothing
        # A wheel that does not turn as it is commanded to: it is blocked, or its encoder lies.
        passed = ticks - look_at[sim, 1]
        for k in range(2):
            for j in range(late.shape[2] - 1, 0, -1):
                late[sim, k, j] = late[sim, k, j - 1]
            late[sim, k, 0] = asked[sim, k] / passed
            # By all that was commanded within the latency it is to turn so fast at the least.
            least = late[sim, k, 0]
            for j in range(1, late.shape[2]):
                same = late[sim, k, j] * least > 0.0
                least = math.copysign(min(abs(late[sim, k, j]), abs(least)), least) if same else 0.0
            done = (position[sim, k] - start[sim, k]) / (passed * dt)
            is_slow = abs(least) > _LEAST_SPEED and (done if least > 0.0 else -done) < 0.5 * abs(least)
            looks[sim, k] = looks[sim, k] + 1 if is_slow else 0
        if max(looks[sim, 0], looks[sim, 1]) >= _LOOKS:
            protective_stop[sim], looks[sim, 0], looks[sim, 1] = _BLOCKED, 0, 0
        if gyro >= 0:
            # Wheels and gyroscope that do not agree about how far the base turned: one of them lies, or slips.
            yaw = ((position[sim, 1] - start[sim, 1]) - (position[sim, 0] - start[sim, 0])) * yaw_per_turn
            apart, largest = abs(yaw - turned[sim] * dt), max(abs(yaw), abs(turned[sim] * dt))
            is_apart = apart > _LEAST_TURN * passed * dt and apart > 0.5 * largest
            looks[sim, 2] = looks[sim, 2] + 1 if is_apart else 0
            if looks[sim, 2] >= _LOOKS:
                protective_stop[sim], looks[sim, 2] = _IMPLAUSIBLE, 0
        turned[sim] = 0.0
        look_at[sim, 0], look_at[sim, 1], look_at[sim, 2] = ticks + period, ticks, stamp_ns[sim]
        for k in range(2):
            asked[sim, k], start[sim, k] = 0.0, position[sim, k]


class BaseController(Controller):
    """Twist commands to wheel speeds, for bases with two driven wheels.

    A command is the forward speed [m/s] and the yaw rate [rad/s]; an actuator command is a wheel speed [rad/s], or the
    twist itself for a base whose own controller turns it into those.

    Args:
        drive: limits and wheels.
        n: number of bases.
        control_hz: ticks a second [Hz].
        monitor: what keeps them from driving into what their scans show, the first values of the reading's sensors.
        gyro: which of the reading's sensors is the yaw rate of a gyroscope [rad/s]; None if there is none.
        takes: what the plant takes, see `Plant.takes`.
        latency_s: time from a command until the readings show it [s].

    Raises:
        ConfigError: the wheels cannot turn the base as fast as its velocity limit allows.
    """

    joints = 2

    def __init__(
        self,
        drive: Drive,
        n: int,
        control_hz: int,
        *,
        monitor: CollisionMonitor | None = None,
        gyro: int | None = None,
        takes: str = "actuators",
        latency_s: float = 0.0,
    ) -> None:
        limits = drive.limits
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
        self.limits = np.zeros(n, np.int64)
        # Of the wheels since the last look at their progress: how far they were to turn, where they were, and how far
        # the gyroscope states that the bases turned; and looks that found otherwise.
        self._asked, self._start = np.zeros((2, n, self.joints))
        self._turned, self._looks = np.zeros(n), np.zeros((n, 3), np.int64)
        # Each robot has its own time for it, counted from its start: an episode does not depend on those beside it.
        self._ticks, self._dt = 0, 1 / control_hz
        self._period = max(1, round(drive.stalled_s / _LOOKS * control_hz))
        self._look_at = np.tile([self._period, 0, -1], (n, 1))
        self._late = np.zeros((n, self.joints, 1 + math.ceil(latency_s * control_hz / self._period - 1e-9)))
        self._stamp_ns, self._first = np.zeros(n, np.int64), np.zeros((n, self.joints))
        self._patience_s, self._latency_s = drive.stalled_s + latency_s, latency_s
        wheels = 1.0 / drive.wheel_radius, per_yaw, drive.max_wheel_speed
        turn, error = drive.wheel_radius / drive.wheel_separation, drive.max_torque / drive.servo_gain
        change = np.array([limits.acceleration, limits.stop_deceleration]) / control_hz
        jerk = np.asarray(limits.jerk) / control_hz**2
        largest = np.asarray(limits.velocity, float), change[0], np.tile(change[1], (n, 1)), jerk, np.array(wheels)
        state = self._target, self.command, self._before, self._rate, self._hard, self.limits
        self._limit = limit_command.bind(*state, *largest)
        looks = self._start, self._asked, self._turned, self._looks, self._look_at, self._late
        numbers = np.array([*wheels[:2], turn, error, control_hz]), self._period, -1 if gyro is None else gyro
        flags = self.limits, self.protective_stop
        self._drive_wheels = drive_wheels.bind(self.command, self._wheel_speeds, *looks, *flags, *numbers)

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
                self.limits[near.any(axis=1)] |= Limit.CLEARANCE
                self._rate[near] = 0.0  # the next change starts anew: such a large one could not end in time
        self._ticks += 1
        # Readings without stamps are those of the tick.
        self._stamp_ns[:] = self._ticks if reading.stamp_ns is None else reading.stamp_ns
        self._drive_wheels(reading.position, reading.velocity, reading.sensors, self._stamp_ns, self._ticks)
        if np.count_nonzero(self.protective_stop):
            self.cause = self._explain(int(np.flatnonzero(self.protective_stop)[0]), reading)

    def _explain(self, sim: int, reading: PlantReading) -> str:
        if self.protective_stop[sim] == _IMPLAUSIBLE:
            return "Wheels and gyroscope do not agree about how far the base turned: one of them is wrong, or it slips."
        wanted, found = (
            ", ".join(f"{speed:.1f}" for speed in row[sim]) for row in (self._wheel_speeds, reading.velocity)
        )
        late = f", of which {self._latency_s:g} s are its latency" if self._latency_s else ""
        if np.abs(reading.position[sim] - self._first[sim]).max() < _STANDS_RAD:
            why = "They have not turned at all: its motors are off, or it does not take the commands."
        else:
            why = "Something blocks one, its encoder is wrong, or the base follows later than that."
        return f"The wheels read {found} rad/s and not {wanted} for {self._patience_s:.2g} s{late}. {why}"

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
        self._asked[ids], self._turned[ids], self._start[ids] = 0.0, 0.0, reading.position[ids]
        self._looks[ids], self._late[ids], self._first[ids] = 0, 0.0, reading.position[ids]
        self._look_at[ids] = self._ticks + self._period, self._ticks, -1
        self.drive.reset_odometry(ids, reading.position[ids])
        if self._monitor is not None:
            self._monitor.forget(ids)  # what it remembers is where odometry was before

    def restart(self, ids: NDArray[np.intp]) -> None:
        """Forget everything about bases that were put somewhere else."""
        for array in (self.command, self._target, self._wheel_speeds, self._rate, self._hard, self.limits):
            array[ids] = 0
        if self._monitor is not None:
            self._monitor.forget(ids)

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
