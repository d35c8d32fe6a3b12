"""The controllers of bases with two driven wheels, as a part of the compiled tick: see `drive`."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Drive
from bhd_lerobot.control.base.collision_monitor import MONITOR, forget_scans
from bhd_lerobot.control.base.drive import IMPLAUSIBLE, LOOKS, REST, read_odometry
from bhd_lerobot.control.controller import Controller
from bhd_lerobot.control.plant import PlantReading
from bhd_lerobot.control.record import LOOKS as MOST_LOOKS
from bhd_lerobot.errors import ConfigError

Array = NDArray[np.float64]


class BaseController(Controller):
    """Twist commands to wheel speeds, for bases with two driven wheels.

    A command is the forward speed [m/s] and the yaw rate [rad/s]; an actuator command is a wheel speed [rad/s], or the
    twist itself for a base whose own controller turns it into those.

    Args:
        drive: limits and wheels.
        n: number of bases.
        control_hz: ticks a second [Hz].
        monitors: what keeps them from driving into what their scans show, the first values of the reading's sensors;
            see `new_monitors`.
        gyro: which of the reading's sensors is the yaw rate of a gyroscope [rad/s]; None if there is none.
        takes: what the plant takes, see `Plant.takes`.
        latency_s: time from a command until the readings show it [s].

    Raises:
        ConfigError: the wheels cannot turn the base as fast as its velocity limit allows, or the latency is too long.
    """

    joints = width = 2
    is_compiled = True

    def __init__(
        self,
        drive: Drive,
        n: int,
        control_hz: int,
        *,
        monitors: NDArray | None = None,
        gyro: int | None = None,
        takes: str = "actuators",
        latency_s: float = 0.0,
    ) -> None:
        super().__init__(n)
        self.monitors = np.zeros(1, MONITOR) if monitors is None else monitors
        self.drive, limits, states, numbers = drive, drive.limits, self.states, self.numbers[0]
        self.command: Array = states["command"][:, :2]
        self.actuators: Array = states["actuators"][:, :2]
        self.busy, self.protective_stop, self.limits = (states[k] for k in ("busy", "protective_stop", "limits"))
        self.contact_wrench = np.zeros((n, 0))
        per_yaw = drive.wheel_separation / 2 / drive.wheel_radius
        fastest = drive.max_wheel_speed / per_yaw
        if limits.velocity[1] > fastest * (1 + 1e-9):
            raise ConfigError(
                f"The limit of {limits.names[1]} is {limits.velocity[1]}; wheels of {drive.max_wheel_speed:g} rad/s at "
                f"the most can turn the base at {fastest:g} rad/s."
            )
        self._patience_s, self._latency_s = drive.stalled_s + latency_s, latency_s
        period = max(1, round(drive.stalled_s / LOOKS * control_hz))
        late = 1 + math.ceil(latency_s * control_hz / period - 1e-9)
        if late > MOST_LOOKS:
            most = (MOST_LOOKS - 1) * period / control_hz
            raise ConfigError(f"The plant's latency_s is {latency_s:g}; a base is controlled with at most {most:g} s.")
        numbers["is_drive"], numbers["takes_twist"] = True, takes == "twist"
        numbers["joints"] = numbers["width"] = 2
        numbers["hz"], numbers["period_s"] = control_hz, 1.0 / control_hz
        numbers["velocity"], numbers["jerk"] = limits.velocity, np.asarray(limits.jerk) / control_hz**2
        numbers["acceleration"] = np.asarray(limits.acceleration) / control_hz
        numbers["stop"] = np.asarray(limits.stop_deceleration) / control_hz
        numbers["per_speed"], numbers["per_yaw"] = 1.0 / drive.wheel_radius, per_yaw
        numbers["most_wheel_speed"], numbers["half_radius"] = drive.max_wheel_speed, drive.wheel_radius / 2
        numbers["turn"], numbers["largest_error"] = self._turn, drive.max_torque / drive.servo_gain
        numbers["counts"] = drive.encoder_ticks / (2 * np.pi)
        metres = drive.wheel_radius / numbers["counts"]  # that a wheel rolls in one encoder count
        numbers["per_count"], numbers["yaw_per_count"] = metres / 2, metres / drive.wheel_separation
        numbers["period_ticks"], numbers["late"], numbers["gyro"] = period, late, -1 if gyro is None else gyro
        self._read_odometry = read_odometry.bind(states, self.numbers)

    @property
    def _turn(self) -> float:
        return self.drive.wheel_radius / self.drive.wheel_separation

    @property
    def cause(self) -> str:
        """Why the last stop of a base's own was, as text."""
        for state in self.states[self.states["stopped_for"] != 0]:
            return self._explain(state)
        return ""

    def _explain(self, state: Any) -> str:
        if state["stopped_for"] == IMPLAUSIBLE:
            return "Wheels and gyroscope do not agree about how far the base turned: one of them is wrong, or it slips."
        wanted, found = (", ".join(f"{speed:.1f}" for speed in pair) for pair in state["stopped_at"].reshape(2, 2))
        late = f", of which {self._latency_s:g} s are its latency" if self._latency_s else ""
        if state["stood"]:
            why = "They have not turned at all: its motors are off, or it does not take the commands."
        else:
            why = "Something blocks one, its encoder is wrong, or the base follows later than that."
        return f"The wheels read {found} rad/s and not {wanted} for {self._patience_s:.2g} s{late}. {why}"

    def at_rest(self) -> NDArray[np.bool_]:
        """Return whether each base is commanded to be at rest, shape (n,)."""
        return np.asarray((np.abs(self.command) < REST).all(axis=1))

    def configure(self, ids: NDArray[np.intp], reading: PlantReading) -> None:
        """Start odometry here."""
        states, position = self.states, reading.position[ids]
        for name in ("asked", "turned", "looks", "late", "odometry"):
            states[name][ids] = 0
        states["start"][ids] = states["first"][ids] = position
        states["encoder"][ids] = np.floor(position * self.numbers["counts"])
        states["look_at"][ids, 0] = states["ticks"][ids] + self.numbers["period_ticks"]
        states["look_at"][ids, 1], states["look_at"][ids, 2] = states["ticks"][ids], -1
        self._forget_scans(ids)  # what it remembers is where odometry was before

    def restart(self, ids: NDArray[np.intp]) -> None:
        """Forget the scans of bases that were put somewhere else."""
        self._forget_scans(ids)

    def _forget_scans(self, ids: NDArray[np.intp]) -> None:
        if self.monitors["beams"][0]:
            forget_scans(self.monitors, ids)

    def efforts(self, reading: PlantReading) -> Array:
        """Return the torques of the servos [N m], shape (n, joints)."""
        turn = self.command[:, 1:] * self.numbers["per_yaw"] * (-1.0, 1.0)
        wheels = self.command[:, :1] * self.numbers["per_speed"] + turn
        torque = (wheels - reading.velocity) * self.drive.servo_gain
        return np.minimum(np.maximum(torque, -self.drive.max_torque), self.drive.max_torque)

    def odometry(self) -> Array:
        """Return x [m], y [m] and yaw [rad] since the start, from the encoders, shape (n, 3)."""
        return self.states["odometry"].copy()

    def odometry_at(self, angles: Array) -> Array:
        """Return the odometry with the motion since the last tick added, shape (n, 3).

        Args:
            angles: wheel angles [rad], shape (n, 2).
        """
        out = np.empty((len(angles), 3))
        self._read_odometry(angles, out)
        return out

    def measured(self, reading: PlantReading) -> Array:
        """Return the twist that the wheels' speeds mean, shape (n, 2)."""
        return twist_from_wheels(self.drive, reading.velocity)


def twist_from_wheels(drive: Drive, wheels: Array) -> Array:
    """Return the twists of bases whose wheels turn at these speeds [rad/s] without slip, shape (n, 2)."""
    twist = np.empty_like(wheels)
    twist[:, 0] = (wheels[:, 0] + wheels[:, 1]) * (drive.wheel_radius / 2)
    twist[:, 1] = (wheels[:, 1] - wheels[:, 0]) * (drive.wheel_radius / drive.wheel_separation)
    return twist
