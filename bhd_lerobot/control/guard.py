"""The last check before the wire: what is really written to the actuators, whatever computed it."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Arm, Body
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
        start: where an actuator's first command has to be near to, as a share of its joint's position: 1 for servos of
            positions, 0 for wheels, which start at rest; not a number where it may be anything in range.
    """

    lower: Array
    upper: Array
    change: Array
    bend: Array
    start: Array

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
            ConfigError: neither a base nor an arm, or an arm that is to take twists.
        """
        if body.drive is not None:
            drive, limits = body.drive, body.drive.limits
            stop = np.maximum(limits.acceleration, limits.stop_deceleration)
            sideways = stop[1] * drive.wheel_separation / 2  # [m/s^2] of a wheel that turns the base
            if takes == "twist":
                most = np.minimum(limits.velocity, (drive.max_wheel_speed * drive.wheel_radius, np.inf))
                change = np.array((max(stop[0], sideways), stop[1])) / control_hz
            else:
                most = np.full(2, drive.max_wheel_speed)
                change = np.full(2, (stop[0] + sideways) / drive.wheel_radius / control_hz)
            largest = most * (1 + 1e-9)
            return cls(-largest, largest, change * _TOLERANCE, np.full(2, np.inf), np.zeros(2))
        if takes == "twist":
            raise ConfigError(f"The plant takes twists (Plant.takes), and the body {body.name!r} is no base.")
        arm = body.need(Arm)
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
        start = np.ones(len(change))
        start[-1] = np.nan  # what is gripped is not let go of: the opening commanded is not the one that is
        if arm.actuation == "torque":
            effort = np.asarray(reference.effort[:-1])
            lower[:-1], upper[:-1] = -effort, effort
            change[:-1] = effort / (FULL_TORQUE_S * control_hz) * _TOLERANCE
            bend[:-1] = np.inf
            start[:] = np.nan
        return cls(lower, upper, change, bend, start)


@kernel("b1(f8[:,::1], f8[:,::1], b1[::1], f8[::1], f8[::1], f8[::1], f8[::1], f8[:,:], f8[:,:], f8, b1)")
def check_commands(  # noqa: PLR0917
    written: Array,
    rate: Array,
    unsafe: NDArray[np.bool_],
    lower: Array,
    upper: Array,
    most: Array,
    bend: Array,
    actuators: Array,
    position: Array,
    ticks: float,
    is_sparse: bool,
) -> bool:
    """Take safe commands over into `written`; let others continue from there, at a falling speed. Return if any do."""
    any_unsafe = False
    for sim in range(len(written)):
        unsafe[sim] = False
        for k in range(len(lower)):
            value = actuators[sim, k]
            change = (value - written[sim, k]) / ticks
            is_near = -most[k] <= change <= most[k] and lower[k] <= value <= upper[k]  # not if it is no number
            # When commands were more than a tick apart, it is not known what was in between.
            is_bent = not is_sparse and abs(change - rate[sim, k]) > bend[k]
            if is_bent and (value <= position[sim, k] if change > 0.0 else change < 0.0 and value >= position[sim, k]):
                is_bent = False
            unsafe[sim] |= is_bent or not is_near
        any_unsafe |= unsafe[sim]
        for k in range(len(lower)):
            before, value = written[sim, k], actuators[sim, k]
            if unsafe[sim]:
                slower = rate[sim, k] - clamp(rate[sim, k], -bend[k], bend[k])
                value = clamp(before + slower, lower[k], upper[k])
                rate[sim, k] = value - before
            else:
                rate[sim, k] = (value - before) / ticks
            written[sim, k] = value
    return any_unsafe


class Guard:
    """Lets actuator commands through that are finite, in range, near enough to the last ones, and bent gradually.

    It knows nothing of how they came about: it is for what nobody thought of, such as a trajectory in shared memory
    that another process overwrote. The command of a robot that it does not let through goes on from the last safe ones,
    at a falling speed. A position servo's command may always come nearer to where the joint is: that takes torque away.

    Attributes:
        written: what may be written, shape (n, actuators).
        rate: its last change, for each tick, shape (n, actuators).

    Args:
        limits: what may be written.
        n: number of robots.
    """

    def __init__(self, limits: WireLimits, n: int) -> None:
        self.limits, shape = limits, (n, len(limits.lower))
        self.written, self.rate = np.zeros(shape), np.zeros(shape)
        self._unsafe, self._is_sparse = np.zeros(n, np.bool_), False  # the last commands were more than a tick apart
        bounds = limits.lower, limits.upper, limits.change, limits.bend
        self._check = check_commands.bind(self.written, self.rate, self._unsafe, *bounds)

    def restart(self, ids: NDArray[np.intp], actuators: Array) -> None:
        """Start from commands that the next ones need not be near to: the robots were put or moved somewhere else.

        Args:
            ids: the robots.
            actuators: their commands, shape (n, actuators).
        """
        self.written[ids], self.rate[ids] = actuators[ids], 0.0

    def start(self, actuators: Array, position: Array) -> None:
        """Start from where the robots are, because someone else held them there.

        Args:
            actuators: the first commands, shape (n, actuators).
            position: of the joints, shape (n, joints).
        """
        start = self.limits.start
        known = np.isfinite(start)
        first = np.where(known, position * np.where(known, start, 0.0), actuators)
        self.restart(np.arange(len(first)), first)

    def check(self, actuators: Array, position: Array, ticks: int = 1) -> NDArray[np.bool_] | None:
        """Check commands, and take those that are safe over into `written`.

        Args:
            actuators: what will be written, shape (n, actuators).
            position: of the joints, shape (n, joints).
            ticks: how many ticks the last commands are old.

        Returns:
            The robots whose commands were not safe, shape (n,), until the next check; None if there are none.
        """
        is_sparse, self._is_sparse = self._is_sparse or ticks > 1, ticks > 1
        return self._unsafe if self._check(actuators, position, float(max(ticks, 1)), is_sparse) else None
