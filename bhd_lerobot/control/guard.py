"""The last check before the wire: what is really written to the actuators, whoever computed it."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Arm, Body, MobileBase
from bhd_lerobot.errors import ConfigError

Array = NDArray[np.float64]

FULL_TORQUE_S = 0.1  # [s] a motor's torque goes from none to its largest in no less: an estimate that spares gears
# Sums of a tick's changes miss the limits that they were made with by their rounding, and a trajectory's last row lies
# inside a tick.
_TOLERANCE = 1.02


@dataclass(frozen=True)
class WireLimits:
    """What may be written to the actuators of a body; each array has shape (actuators,).

    Wheels take speeds [rad/s]. An arm's joints take positions [rad] or torques [N m], its gripper an opening [m].

    Attributes:
        lower: smallest value.
        upper: largest value.
        change: largest change from one tick to the next.
        start: where an actuator's first command has to be near to, as a share of its joint's position: 1 for servos of
            positions, 0 for wheels, which start at rest; not a number where it may be anything in range.
    """

    lower: Array
    upper: Array
    change: Array
    start: Array

    @classmethod
    def of(cls, body: Body, control_hz: int) -> Self:
        """Return the limits of a body, from its own numbers.

        Wheels may change their speed as fast as the hardest stop does. Positions may change by the largest speed, and
        by what the lead for the servos' damping adds when the reference accelerates; torques by what spares the gears.

        Args:
            body: the robot.
            control_hz: ticks a second [Hz].

        Raises:
            ConfigError: neither a base nor an arm.
        """
        if isinstance(body, MobileBase):
            drive, limits = body.drive, body.limits
            stop = np.maximum(limits.acceleration, limits.stop_deceleration)
            change = (stop[0] + stop[1] * drive.wheel_separation / 2) / drive.wheel_radius / control_hz
            largest = np.full(2, drive.max_wheel_speed * (1 + 1e-9))
            return cls(-largest, largest, np.full(2, change * _TOLERANCE), np.zeros(2))
        if not isinstance(body, Arm):
            raise ConfigError(f"Body {body.name!r} is a {type(body).__name__}; no limits are known for its actuators.")
        reference = body.limits
        lead = np.asarray(body.lead_s)
        hardest = np.maximum(reference.acceleration, reference.stop_deceleration)
        if body.actuation == "torque":
            lead[:] = 0.0
        # A reference that stops at the end of its range is led beyond it by no more than this: the largest value of
        # lead * v - v^2 / (2 a).
        beyond = hardest * lead**2 / 2 + 1e-6
        lower, upper = np.asarray(reference.lower) - beyond, np.asarray(reference.upper) + beyond
        change = (np.asarray(reference.velocity) + 2 * lead * hardest) / control_hz * _TOLERANCE
        start = np.ones(len(change))
        start[-1] = np.nan  # what is gripped is not let go of: the opening commanded is not the one that is
        if body.actuation == "torque":
            effort = np.asarray(reference.effort[:-1])
            lower[:-1], upper[:-1] = -effort, effort
            change[:-1] = effort / (FULL_TORQUE_S * control_hz) * _TOLERANCE
            start[:] = np.nan
        return cls(lower, upper, change, start)


class Guard:
    """Lets actuator commands through that are finite, in range, and near enough to the last ones.

    It knows nothing of how they came about: it is for what nobody thought of, such as a trajectory in shared memory
    that another process overwrote. A robot whose command it does not let through keeps the last safe one.

    Attributes:
        written: what may be written, shape (n, actuators).

    Args:
        limits: what may be written.
        n: number of robots.
    """

    def __init__(self, limits: WireLimits, n: int) -> None:
        self.limits = limits
        width = len(limits.lower)
        # Both checks at once: the distances from the last command and from the middle of the range.
        self._from = np.zeros((2, n, width))
        self._from[1] = (limits.lower + limits.upper) / 2
        self.written: Array = self._from[0]
        self._most = np.zeros((2, n, width))
        self._most[0], self._most[1] = limits.change, (limits.upper - limits.lower) / 2
        self._work, self._flags = np.zeros((2, n, width)), np.zeros((2, n, width), np.bool_)
        self._all = self._flags.size
        # Plain numbers are several times cheaper than arrays of a few.
        self._bounds = list(zip(limits.lower.tolist(), limits.upper.tolist(), limits.change.tolist(), strict=True))

    def restart(self, ids: NDArray[np.intp], actuators: Array) -> None:
        """Start from commands that the next ones need not be near to: the robots were put or moved somewhere else.

        Args:
            ids: the robots.
            actuators: their commands, shape (n, actuators).
        """
        self.written[ids] = actuators[ids]

    def start(self, actuators: Array, position: Array) -> None:
        """Start from where the robots are, because somebody else held them there.

        Args:
            actuators: the first commands, shape (n, actuators).
            position: of the joints, shape (n, joints).
        """
        start = self.limits.start
        known = np.isfinite(start)
        self.written[:] = np.where(known, position * np.where(known, start, 0.0), actuators)

    def check(self, actuators: Array, ticks: int = 1) -> NDArray[np.bool_] | None:
        """Check commands, and take those that are safe over into `written`.

        Args:
            actuators: what is to be written, shape (n, actuators).
            ticks: how many ticks the last commands are old.

        Returns:
            The robots whose last safe command stays, shape (n,); None if there are none.
        """
        if len(actuators) == 1 and ticks <= 1 and self._is_safe(actuators[0].tolist(), self.written[0].tolist()):
            self.written[:] = actuators
            return None
        work = np.subtract(actuators, self._from, out=self._work)
        np.abs(work, out=work)
        if ticks > 1:
            work[0] /= ticks
        # What is not a number is not less than anything either.
        np.less_equal(work, self._most, out=self._flags)
        if np.count_nonzero(self._flags) == self._all:
            self.written[:] = actuators
            return None
        good: NDArray[np.bool_] = np.asarray(self._flags.all(axis=(0, 2)))
        np.copyto(self.written, actuators, where=good[:, None])
        return ~good

    def _is_safe(self, values: list[float], last: list[float]) -> bool:
        """Return what the two comparisons of `check` say about one robot."""
        if values == last:  # never so if one is not a number
            return True
        for value, before, (lower, upper, change) in zip(values, last, self._bounds, strict=True):
            if not (lower <= value <= upper and -change <= value - before <= change):
                return False
        return True
