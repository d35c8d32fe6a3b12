"""The controller of bases with two driven wheels."""

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import MobileBase
from bhd_lerobot.control.base import limits as safety
from bhd_lerobot.control.base.diff_drive import DiffDrive
from bhd_lerobot.control.controller import Controller
from bhd_lerobot.control.messages import Limit, Mode
from bhd_lerobot.control.plant import PlantReading
from bhd_lerobot.errors import ConfigError

_REST = 1e-9  # a ramp has arrived when the command is this close to zero


class BaseController(Controller):
    """Twist commands to wheel speeds, for bases with two driven wheels.

    A command is the forward speed [m/s] and the yaw rate [rad/s]; an actuator command is a wheel speed [rad/s].

    Args:
        body: limits and wheels.
        n: number of bases.
        control_hz: ticks a second [Hz].

    Raises:
        ConfigError: the wheels cannot turn the base as fast as its velocity limit allows.
    """

    joints = 2

    def __init__(self, body: MobileBase, n: int, control_hz: int) -> None:
        limits, drive = body.limits, body.drive
        self.width = width = len(limits.names)
        self.drive = DiffDrive(drive, n)
        self.command = np.zeros((n, width))
        self.actuators = np.zeros((n, self.joints))
        self.busy, self.blocked = (np.zeros(n, np.bool_) for _ in range(2))
        self._servo_gain = drive.servo_gain
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
        self._largest = np.broadcast_to(self._change, (n, width)).copy()
        self._clipped = np.zeros((n, width))
        self._reference = np.zeros((n, self.joints))
        self._settled = self._is_clipped = False
        # The sum of 0 * x is 0 if and only if every x is finite; unlike a plain sum it neither overflows nor warns.
        self._flat_target, self._zeros = self._target.reshape(-1), np.zeros(n * width)
        self._limited_velocity = np.zeros((n, width), np.bool_)
        self._limited_change = np.zeros((n, width), np.bool_)
        self._limited_wheels = np.zeros(n, np.bool_)
        self._limited_effort = np.zeros((n, self.joints), np.bool_)
        self._limited_finite = np.zeros(n, np.bool_)
        self._wheels = (1.0 / drive.wheel_radius, per_yaw, drive.max_wheel_speed, self._limited_wheels)

    def set_setpoint(self, values: NDArray[np.float64], mask: NDArray[np.bool_]) -> None:
        """Head for new twists, with the normal accelerations."""
        np.copyto(self._target, values, where=mask[:, None])
        np.copyto(self._largest, self._change, where=mask[:, None])
        self._settled = self._is_clipped = False

    def stop(self, mask: NDArray[np.bool_], cause: Mode) -> None:
        """Head for rest, with the normal decelerations or with those of an emergency stop."""
        hard = cause in (Mode.ESTOP, Mode.FAULT)
        self._target[mask] = 0.0
        self._largest[mask] = self._stop_change if hard else self._change
        self._settled = self._is_clipped = False

    def run(self, reading: PlantReading) -> None:
        """Advance by one tick."""
        if not self._settled:
            self._filter()
        # Where nothing changed since the last tick the command stands, and so do the wheel speeds that it means.
        np.copyto(self.actuators, self._reference)
        safety.limit_effort(self.actuators, reading.velocity, self._largest_error, self._limited_effort)
        self.drive.update_odometry(reading.position)

    def _filter(self) -> None:
        """From the targets to the commands applied in this tick, and the wheel speeds that they mean."""
        if not self._is_clipped:
            self._clip()
        arrived = safety.limit_change(self._clipped, self.command, self._largest, self.command, self._limited_change)
        # Both ends of a change can be within the wheels' limit and the way between them not: the two dimensions
        # change at different rates.
        limited = safety.limit_wheel_speed(self.command, *self._wheels)
        self._settled = arrived and not limited
        self.drive.wheels_from_twist(self.command, self._reference)

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
        self.drive.reset_odometry(ids, reading.position[ids])

    def restart(self, ids: NDArray[np.intp]) -> None:
        """Forget everything about bases that were put somewhere else."""
        for array in (self.command, self._target, self.actuators, self._reference):
            array[ids] = 0.0
        self._largest[ids] = self._change
        for flags in self._flags():
            flags[ids] = False
        self._settled = self._is_clipped = False

    def take_limits(self) -> NDArray[np.int64]:
        """Return the `Limit` flags raised since the last call, shape (n,), and clear them."""
        limits = (
            self._limited_finite * int(Limit.NON_FINITE)
            + (self._limited_velocity.any(axis=1) | self._limited_wheels) * int(Limit.VELOCITY)
            + self._limited_change.any(axis=1) * int(Limit.ACCELERATION)
            + self._limited_effort.any(axis=1) * int(Limit.EFFORT)
        )
        for flags in self._flags():
            flags[:] = False
        self._settled = self._is_clipped = False  # a limit that still holds is reported again in the next frame
        return limits

    def efforts(self, reading: PlantReading) -> NDArray[np.float64]:
        """Return the commanded torques of the servos [N m], shape (n, joints)."""
        return (self.actuators - reading.velocity) * self._servo_gain

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
        )
