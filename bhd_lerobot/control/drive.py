"""What a tick does for a base with two driven wheels: from a twist to wheel speeds, and odometry."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Drive
from bhd_lerobot.control.collision_monitor import MONITOR, forget_scans, keep_clear
from bhd_lerobot.control.controller import Controller
from bhd_lerobot.control.kernels import clamp, kernel, largest_change
from bhd_lerobot.control.messages import Limit, Mode, Watchdog
from bhd_lerobot.control.plant import PlantReading
from bhd_lerobot.control.record import LOOKS as MOST_LOOKS
from bhd_lerobot.errors import ConfigError

Array = NDArray[np.float64]

_REST = 1e-9  # a ramp has arrived when the command is this close to zero
_ARRIVED = 1e-12  # nearer than this it is there
_LOOKS = 6  # looks at the wheels' progress until one is blocked, or its encoder is
_LEAST_SPEED = 1.0  # [rad/s] a wheel that is to turn slower than this is not judged
_STANDS = 0.02  # [rad] a wheel that turned less has not moved
_LEAST_TURN = 0.3  # [rad/s] by which wheels and gyroscope may differ: several times what a cheap one drifts
_ESTOP = int(Mode.ESTOP)  # it and FAULT are the last modes
_NON_FINITE, _VELOCITY, _ACCELERATION = int(Limit.NON_FINITE), int(Limit.VELOCITY), int(Limit.ACCELERATION)
_EFFORT, _CLEARANCE = int(Limit.EFFORT), int(Limit.CLEARANCE)
_BLOCKED, _IMPLAUSIBLE = int(Watchdog.BLOCKED), int(Watchdog.PLANT)


@kernel()
def drive(state: Any, limits: Any, monitor: Any, sensors: Array, sensors_ns: int) -> None:
    """Advance a base by one tick, once it has been told its modes and setpoint.

    Args:
        monitor: what keeps it from driving into what its scans show; a record without beams if nothing does.
        sensors: the ranges of a scan [m], and what the gyroscope reads [rad/s].
        sensors_ns: when they were measured [ns].
    """
    integrate(state, limits)
    if state.by_goal:  # of the arm on it
        state.target[0] = state.target[1] = 0.0
    limit_command(state, limits)
    if monitor.beams:
        keep_clear(state, limits, monitor, sensors, sensors_ns)
    turn_wheels(state, limits)
    state.ticks += 1
    check_wheels(state, limits, sensors)


@kernel()
def tell_drive(state: Any, limits: Any) -> None:
    """Brake for the modes that were entered, then head for a new setpoint; what is told stays noted."""
    if state.entered:
        # What is to stop gets no faster meanwhile: an acceleration ends at once, the brake comes gradually.
        for k in range(2):
            state.target[k] = 0.0
            if state.rate[k] * state.command[limits.arm_values + k] > 0.0:
                state.rate[k] = 0.0
        state.brakes_hard = state.mode >= _ESTOP
        if not state.brakes_hard:
            state.stopped_for = 0
    if state.has_setpoint:
        for k in range(2):
            state.target[k] = state.requested[limits.arm_values + k]
        state.brakes_hard = False


@kernel()
def is_base_at_rest(state: Any, limits: Any) -> bool:
    """Return whether a base is commanded to be at rest."""
    first = limits.arm_values
    return abs(state.command[first]) < _REST and abs(state.command[first + 1]) < _REST


@kernel()
def odometry_after(state: Any, limits: Any, left: float, right: float) -> tuple[float, float, float]:
    """Return x, y [m] and yaw [rad] with the motion since the last tick, along the chord of the arc.

    The encoders' resolution and the tyres' slip make it drift, as odometry does.

    Args:
        left: the left wheel's encoder [counts].
        right: the right wheel's.
    """
    moved_left, moved_right = left - state.encoder[0], right - state.encoder[1]
    distance, turn = (moved_left + moved_right) * limits.per_count, (moved_right - moved_left) * limits.yaw_per_count
    heading = turn * 0.5 + state.odometry[2]
    if not math.isfinite(heading):
        heading = math.nan  # Python raises for the cosine of an infinity
    x, y = state.odometry[0] + math.cos(heading) * distance, state.odometry[1] + math.sin(heading) * distance
    return x, y, state.odometry[2] + turn


@kernel()
def integrate(state: Any, limits: Any) -> None:
    """Add the motion since the last tick to the odometry."""
    first = limits.arm_values
    left, right = np.floor(state.position[first] * limits.counts), np.floor(state.position[first + 1] * limits.counts)
    state.odometry[0], state.odometry[1], state.odometry[2] = odometry_after(state, limits, left, right)
    state.encoder[0], state.encoder[1] = left, right


@kernel("void(state[::1], limits[::1], f8[:,:], f8[:,:])")
def read_odometry(states: Any, limits: Any, angles: Array, out: Array) -> None:
    """Write the odometry of n bases with these wheel angles [rad], shape (n, 2), without updating it."""
    for sim in range(len(states)):
        left, right = np.floor(angles[sim, 0] * limits[0].counts), np.floor(angles[sim, 1] * limits[0].counts)
        out[sim, 0], out[sim, 1], out[sim, 2] = odometry_after(states[sim], limits[0], left, right)


@kernel()
def wheel_room(limits: Any, yaw_rate: float) -> float:
    """Return the largest forward speed with which no wheel is faster than its limit.

    Turning has precedence because it is what avoids an obstacle, and because the two limits cannot fight: in one tick
    the yaw rate changes by so little that the forward speed which it costs stays within its own acceleration limit.
    """
    return max((abs(yaw_rate) * -limits.per_yaw + limits.most_wheel_speed) * (1.0 / limits.per_speed), 0.0)


@kernel()
def limit_command(state: Any, limits: Any) -> None:
    """Bring the command as near to its target as one tick may; note why no nearer.

    The change of each tick is the largest from which the changes can still fall, by the jerk limit from tick to tick,
    so that their sum ends at the target: it arrives without overshoot. A base that brakes hard goes as far as the
    deceleration of a stop allows.
    """
    # Commands are checked when they are sent; a queue in shared memory is written by another process.
    if not (math.isfinite(state.target[0]) and math.isfinite(state.target[1])):
        state.target[0] = state.target[1] = 0.0
        state.limits |= _NON_FINITE
    first = limits.arm_values
    yaw_rate = clamp(state.target[1], -limits.velocity[1], limits.velocity[1])
    room = min(limits.velocity[0], wheel_room(limits, yaw_rate))
    for k in range(2):
        target = yaw_rate if k else clamp(state.target[0], -room, room)
        if target != state.target[k]:
            state.limits |= _VELOCITY
        before, last = state.command[first + k], state.rate[k]
        state.before[k] = before
        jerk, step = limits.jerk[k], target - before
        way = abs(step) / jerk
        if way > limits.acceleration[k] / jerk:
            state.limits |= _ACCELERATION
        if state.brakes_hard:
            if abs(step) > limits.stop[k]:
                state.limits |= _ACCELERATION
                state.command[first + k] = before + clamp(step, -limits.stop[k], limits.stop[k])
            else:
                state.command[first + k] = target
            state.rate[k] = state.command[first + k] - before
            continue
        change = math.copysign(min(largest_change(way) * jerk, limits.acceleration[k]), step)
        change = clamp(change, last - jerk, last + jerk)
        state.command[first + k] = before + change
        if abs(step - change) <= _ARRIVED:  # sums miss it by their rounding
            state.command[first + k] = target
        state.rate[k] = 0.0 if way <= _ARRIVED / jerk and abs(last) <= jerk else change
    # Both ends of a change can be within the wheels' limit and the way between them not: the two dimensions change at
    # different rates.
    room = wheel_room(limits, state.command[first + 1])
    if abs(state.command[first]) > room:
        state.command[first] = clamp(state.command[first], -room, room)
        state.limits |= _VELOCITY
        for k in range(2):
            state.rate[k] = state.command[first + k] - state.before[k]


@kernel()
def turn_wheels(state: Any, limits: Any) -> None:
    """Go from the command to wheel speeds; note whether a servo gives its largest torque."""
    first = limits.arm_values
    straight, turn = state.command[first] * limits.per_speed, state.command[first + 1] * limits.per_yaw
    for k in range(2):
        speed = straight + turn if k else straight - turn
        # A servo beyond its torque gives its largest: that is flagged, and the command stays as it is.
        if abs(speed - state.velocity[first + k]) > limits.largest_error:
            state.limits |= _EFFORT
        state.asked[k] += speed
        state.actuators[first + k] = state.command[first + k] if limits.takes_twist else speed


@kernel()
def check_wheels(state: Any, limits: Any, sensors: Array) -> None:
    """Compare now and then how the wheels turned with what was commanded, and with a gyroscope."""
    if limits.gyro >= 0:
        state.turned += sensors[limits.gyro]
    stamp_ns = state.stamp_ns if limits.has_stamps else state.ticks  # readings without stamps are those of the tick
    if state.ticks < state.look_at[0] or stamp_ns == state.look_at[2]:
        return  # what has not been read again says nothing
    passed, first = state.ticks - state.look_at[1], limits.arm_values
    seconds = passed * limits.period_s
    for k in range(2):
        # A wheel that does not turn as it is commanded to: it is blocked, or its encoder lies.
        for j in range(limits.late - 1, 0, -1):
            state.late[k, j] = state.late[k, j - 1]
        state.late[k, 0] = state.asked[k] / passed
        # By all that was commanded within the latency it is to turn so fast at the least.
        least = state.late[k, 0]
        for j in range(1, limits.late):
            is_same = state.late[k, j] * least > 0.0
            least = math.copysign(min(abs(state.late[k, j]), abs(least)), least) if is_same else 0.0
        done = (state.position[first + k] - state.start[k]) / seconds
        is_slow = abs(least) > _LEAST_SPEED and (done if least > 0.0 else -done) < 0.5 * abs(least)
        state.looks[k] = state.looks[k] + 1 if is_slow else 0
    if max(state.looks[0], state.looks[1]) >= _LOOKS:
        state.protective_stop, state.looks[0], state.looks[1] = _BLOCKED, 0, 0
    if limits.gyro >= 0:
        # Wheels and gyroscope that do not agree about how far the base turned: one of them lies, or slips.
        yaw = (state.position[first + 1] - state.start[1]) - (state.position[first] - state.start[0])
        yaw, turned = yaw * limits.turn, state.turned * limits.period_s
        apart, largest = abs(yaw - turned), max(abs(yaw), abs(turned))
        is_apart = apart > _LEAST_TURN * seconds and apart > 0.5 * largest
        state.looks[2] = state.looks[2] + 1 if is_apart else 0
        if state.looks[2] >= _LOOKS:
            state.protective_stop, state.looks[2] = _IMPLAUSIBLE, 0
    if state.protective_stop:
        state.stopped_for = state.protective_stop
        state.stood = True
        for k in range(2):
            state.stood = state.stood and abs(state.position[first + k] - state.first[k]) < _STANDS
            turn = state.command[first + 1] * limits.per_yaw
            state.stopped_at[k] = state.command[first] * limits.per_speed + (turn if k else -turn)
            state.stopped_at[2 + k] = state.velocity[first + k]
    state.turned = 0.0
    state.look_at[0], state.look_at[1], state.look_at[2] = state.ticks + limits.period_ticks, state.ticks, stamp_ns
    for k in range(2):
        state.asked[k], state.start[k] = 0.0, state.position[first + k]


@kernel()
def drive_back(state: Any, limits: Any) -> None:
    """Make the command again what the wheels have."""
    first = limits.arm_values
    left, right = state.written[first], state.written[first + 1]
    if limits.takes_twist:
        state.command[first], state.command[first + 1] = left, right
    else:
        state.command[first], state.command[first + 1] = (
            (left + right) * limits.half_radius,
            (right - left) * limits.turn,
        )
    state.rate[0] = state.rate[1] = 0.0


@kernel()
def report_drive(state: Any, limits: Any) -> None:
    """Write the twist that the wheels' speeds mean, and the torques of their servos, to the record."""
    first = limits.arm_values
    left, right = state.velocity[first], state.velocity[first + 1]
    state.measured[first], state.measured[first + 1] = (left + right) * limits.half_radius, (right - left) * limits.turn
    straight, turn = state.command[first] * limits.per_speed, state.command[first + 1] * limits.per_yaw
    for k in range(first, first + 2):
        error = (straight - turn if k == first else straight + turn) - state.velocity[k]
        given = clamp(error, -limits.largest_error, limits.largest_error) * limits.servo_gain
        state.torque[k] = state.effort[k] if state.has_effort else given


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
        arm: the controller of the arm that each of them carries: it has the records, and its values are before the
            drive's.

    Raises:
        ConfigError: the wheels cannot turn the base as fast as its velocity limit allows, or the latency is too long.
    """

    joints = width = 2

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
        arm: Controller | None = None,
    ) -> None:
        super().__init__(n, arm)
        self.monitors = np.zeros(1, MONITOR) if monitors is None else monitors
        self.drive, limits, states, numbers = drive, drive.limits, self.states, self.numbers[0]
        first = 0 if arm is None else arm.width
        self.command: Array = states["command"][:, first : first + 2]
        self.actuators: Array = states["actuators"][:, first : first + 2]
        self.busy, self.protective_stop, self.limits = (states[k] for k in ("busy", "protective_stop", "limits"))
        per_yaw = drive.wheel_separation / 2 / drive.wheel_radius
        fastest = drive.max_wheel_speed / per_yaw
        if limits.velocity[1] > fastest * (1 + 1e-9):
            raise ConfigError(
                f"The limit of {limits.names[1]} is {limits.velocity[1]}; wheels of {drive.max_wheel_speed:g} rad/s at "
                f"the most can turn the base at {fastest:g} rad/s."
            )
        self._patience_s, self._latency_s = drive.stalled_s + latency_s, latency_s
        period = max(1, round(drive.stalled_s / _LOOKS * control_hz))
        late = 1 + math.ceil(latency_s * control_hz / period - 1e-9)
        if late > MOST_LOOKS:
            most = (MOST_LOOKS - 1) * period / control_hz
            raise ConfigError(f"The plant's latency_s is {latency_s:g}; a base is controlled with at most {most:g} s.")
        numbers["is_drive"], numbers["takes_twist"] = True, takes == "twist"
        numbers["joints"] = numbers["width"] = first + 2
        numbers["hz"], numbers["period_s"] = control_hz, 1.0 / control_hz
        numbers["velocity"], numbers["jerk"] = limits.velocity, np.asarray(limits.jerk) / control_hz**2
        numbers["acceleration"] = np.asarray(limits.acceleration) / control_hz
        numbers["stop"] = np.asarray(limits.stop_deceleration) / control_hz
        numbers["per_speed"], numbers["per_yaw"] = 1.0 / drive.wheel_radius, per_yaw
        numbers["most_wheel_speed"], numbers["half_radius"] = drive.max_wheel_speed, drive.wheel_radius / 2
        numbers["turn"], numbers["servo_gain"] = self._turn, drive.servo_gain
        numbers["largest_error"] = drive.max_torque / drive.servo_gain
        numbers["counts"] = drive.encoder_ticks / (2 * np.pi)
        metres = drive.wheel_radius / numbers["counts"]  # that a wheel rolls in one encoder count
        numbers["per_count"], numbers["yaw_per_count"] = metres / 2, metres / drive.wheel_separation
        numbers["period_ticks"], numbers["late"], numbers["gyro"] = period, late, -1 if gyro is None else gyro

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
        if state["stopped_for"] == _IMPLAUSIBLE:
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
        return np.asarray((np.abs(self.command) < _REST).all(axis=1))

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

    def odometry(self) -> Array:
        """Return x [m], y [m] and yaw [rad] since the start, from the encoders, shape (n, 3)."""
        return self.states["odometry"].copy()

    def odometry_at(self, angles: Array) -> Array:
        """Return the odometry with the motion since the last tick added, shape (n, 3).

        Args:
            angles: wheel angles [rad], shape (n, 2).
        """
        out = np.empty((len(angles), 3))
        read_odometry.run(self.states, self.numbers, angles, out)
        return out


def twist_from_wheels(drive: Drive, wheels: Array) -> Array:
    """Return the twists of bases whose wheels turn at these speeds [rad/s] without slip, shape (n, 2)."""
    twist = np.empty_like(wheels)
    twist[:, 0] = (wheels[:, 0] + wheels[:, 1]) * (drive.wheel_radius / 2)
    twist[:, 1] = (wheels[:, 1] - wheels[:, 0]) * (drive.wheel_radius / drive.wheel_separation)
    return twist
