"""The last check before the wire: what is really written to the actuators, whatever computed it."""

import math
from dataclasses import dataclass, fields
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Arm, Body, Drive
from bhd_lerobot.control.kernels import clamp, kernel
from bhd_lerobot.errors import ConfigError

Array = NDArray[np.float64]

FULL_TORQUE_S = 0.1  # [s] a motor's torque goes from none to its largest in no less: an estimate that spares gears
# Sums of a tick's changes miss the limits that they were made with by their rounding, and a trajectory's last row lies
# inside a tick.
_TOLERANCE = 1.02


@dataclass(frozen=True)
class WireLimits:
    """What may be written to the actuators of a body; each array has shape (actuators,).

    Wheels take speeds [rad/s], a base of its own controller a twist [m/s, rad/s]. An arm's joints take positions [rad]
    or torques [N m], its gripper an opening [m].

    Attributes:
        lower: smallest value.
        upper: largest value.
        change: largest change from one tick to the next.
        bend: largest difference between two changes that follow each other; infinite where a change is an acceleration,
            or a torque's.
    """

    lower: Array
    upper: Array
    change: Array
    bend: Array

    @classmethod
    def of(cls, body: Body, control_hz: int, takes: str = "actuators") -> Self:
        """Return the limits of a body, from its own numbers.

        Wheels may change their speed as fast as the hardest stop does, and so may a twist; forward speed also as fast
        as a turn takes it away, whose wheels have no more. Positions may change by the largest speed, and by what the
        lead for the servos' damping adds when the reference accelerates; torques by what spares the gears. The changes
        of positions may differ by what the largest acceleration makes of the reference, and of its lead when it turns
        into the opposite one.

        Args:
            body: the robot.
            control_hz: ticks a second [Hz].
            takes: see `Plant.takes`.

        Raises:
            ConfigError: an arm that is to take twists.
        """
        if takes == "twist" and (body.drive is None or body.arm is not None):
            raise ConfigError(f"The plant takes twists (Plant.takes), and the body {body.name!r} is no base.")
        parts = [] if body.arm is None else [cls._of_arm(body.arm, control_hz)]
        if body.drive is not None:
            parts.append(cls._of_drive(body.drive, control_hz, takes))
        return cls(*(np.concatenate([getattr(part, one.name) for part in parts]) for one in fields(cls)))

    @classmethod
    def _of_drive(cls, drive: Drive, control_hz: int, takes: str) -> Self:
        limits = drive.limits
        stop = np.maximum(limits.acceleration, limits.stop_deceleration)
        sideways = stop[1] * drive.wheel_separation / 2  # [m/s^2] of a wheel that turns the base
        if takes == "twist":
            most = np.minimum(limits.velocity, (drive.max_wheel_speed * drive.wheel_radius, np.inf))
            change = np.array((max(stop[0], sideways), stop[1])) / control_hz
        else:
            most = np.full(2, drive.max_wheel_speed)
            change = np.full(2, (stop[0] + sideways) / drive.wheel_radius / control_hz)
        largest = most * (1 + 1e-9)
        return cls(-largest, largest, change * _TOLERANCE, np.full(2, np.inf))

    @classmethod
    def _of_arm(cls, arm: Arm, control_hz: int) -> Self:
        reference = arm.limits
        lead = np.asarray(arm.lead_s)
        hardest = np.maximum(reference.acceleration, reference.stop_deceleration)
        if arm.actuation == "torque":
            lead[:] = 0.0
        # A reference that stops at the end of its range is led beyond it by no more than this: the largest value of
        # lead * v - v^2 / (2 a).
        beyond = hardest * lead**2 / 2 + 1e-6
        lower, upper = np.asarray(reference.lower) - beyond, np.asarray(reference.upper) + beyond
        change = (np.asarray(reference.velocity) + 2 * lead * hardest) / control_hz * _TOLERANCE
        bend = hardest / control_hz * (1 / control_hz + 2 * lead) * _TOLERANCE
        if arm.actuation == "torque":
            effort = np.asarray(reference.effort[:-1])
            lower[:-1], upper[:-1] = -effort, effort
            change[:-1] = effort / (FULL_TORQUE_S * control_hz) * _TOLERANCE
            bend[:-1] = np.inf
        return cls(lower, upper, change, bend)


@kernel()
def braking_way(change: float, bend: float) -> float:
    """Return how far a command still goes whose changes, now `change` >= 0, fall by `bend` from tick to tick."""
    if not change > bend:  # also if there is no limit
        return 0.0
    ticks = math.floor(change / bend)
    return ticks * change - bend * ticks * (ticks + 1.0) * 0.5


@kernel()
def guard(state: Any, limits: Any) -> bool:
    """Let an actuator command through that is finite, in range, near enough to the last one, and bent gradually.

    It knows nothing of how it came about: it is for what nobody thought of, such as a trajectory in shared memory that
    another process overwrote. A safe command becomes what is `written`; another continues from there, at a falling
    speed, for which a safe command leaves room before the end of the range. Wheels brake meanwhile, for however long
    there is no safe command; torques stay. A position servo's command may always come nearer to where the joint is:
    that takes torque away.

    Returns:
        Whether the command was safe.
    """
    is_safe = True
    for k in range(limits.joints):
        value = state.actuators[k]
        change = value - state.written[k]
        # Not if it is no number.
        is_near = -limits.change[k] <= change <= limits.change[k] and limits.lower[k] <= value <= limits.upper[k]
        room = limits.upper[k] - value if change > 0.0 else value - limits.lower[k]
        is_bent = abs(change - state.written_rate[k]) > limits.bend[k]
        if is_bent and (value <= state.position[k] if change > 0.0 else change < 0.0 and value >= state.position[k]):
            is_bent = False
        is_safe = is_safe and is_near and not is_bent and not braking_way(abs(change), limits.bend[k]) > room
    wheels = limits.joints - 2 if limits.is_drive else limits.joints
    for k in range(limits.joints):
        before, value, rate = state.written[k], state.actuators[k], state.written_rate[k]
        if not is_safe:
            slower = rate - clamp(rate, -limits.bend[k], limits.bend[k])
            if k >= wheels:  # as hard as a stop does: the change is for that of forward speed and yaw rate at once
                slower = clamp(-before, -0.5 * limits.change[k], 0.5 * limits.change[k])
            value = clamp(before + slower, limits.lower[k], limits.upper[k])
        state.written_rate[k], state.written[k] = value - before, value
    return is_safe
