"""The last check of actions before another package's robot: what an interface of positions and speeds allows."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.control.messages import Limit
from bhd_lerobot.errors import ConfigError, unknown_name
from bhd_lerobot.options.dotted import flattened
from bhd_lerobot.robots.external.config import GateConfig

Vector = NDArray[np.float64]

# What a robot goes on with, as LeRobot's robots and plug-ins name it: x.vel, linear_velocity, mobile_base.vx, linear.x,
# delta_x, and the sticks of a remote control, remote.lx.
_SPEED = re.compile(
    r"(^|[._])(vel|velocity|speed|rate|rpm|omega|throttle|v[xyz]|vtheta|[xyz]_?vel)$"
    r"|(^|[._])(linear|angular)[._][xyz]$|(^|[._])(twist|cmd_vel|delta|remote)([._]|$)",
    re.IGNORECASE,
)
# What closes on things: gripper.pos, left_gripper, rightGripper, panda_finger_joint1, index_flexor, hand.pos.
_GRIPS = re.compile(
    r"grip|(^|[._])(jaw|claw|clamp|hand|finger|thumb|index|middle|ring|pinky|suction|vacuum)s?\d*([._]|$)",
    re.IGNORECASE,
)


@dataclass(frozen=True)
class Passed:
    """What the gate made of an action.

    Attributes:
        action: what may be sent, shape (actions,).
        limits: `Limit` flags of what was changed: NON_FINITE, POSITION (the range), VELOCITY (the change).
    """

    action: Vector
    limits: int


class Gate:
    """Makes actions finite, keeps them in range, and bounds their change from one frame to the next.

    Args:
        names: the action's names, in order; those of speeds end in `vel`, `velocity`, `speed`, `vx` or the like,
            changes of position (`delta_x`) and sticks (`remote.lx`) count as speeds; all others are positions.
        config: the options.
        known: ranges that the robot's calibration or features say, by name.

    Attributes:
        lower: lowest values, shape (actions,); -inf where no range is known.
        upper: highest values, likewise.
        max_change: largest changes from one frame to the next, likewise.

    Raises:
        ConfigError: an option names no action.
    """

    def __init__(self, names: Sequence[str], config: GateConfig, known: Mapping[str, tuple[float, float]]) -> None:
        self.names = tuple(names)
        given = flattened(config.range)
        is_by_name = isinstance(config.max_change, dict)
        by_name = flattened(config.max_change) if is_by_name else {}
        for option, chosen in (("gate.range", given), ("gate.max_change", by_name)):
            if wrong := [name for name in chosen if name not in self.names]:
                raise ConfigError(unknown_name(f"action of {option}", wrong[0], self.names))
        ranges = [given.get(name) or known.get(name) or (-np.inf, np.inf) for name in self.names]
        self.lower, self.upper = np.array(ranges, np.float64).reshape(-1, 2).T
        self._is_speed = np.array([bool(_SPEED.search(name)) for name in self.names], np.bool_)
        self._grips = np.array([bool(_GRIPS.search(name)) for name in self.names], np.bool_)
        every = np.inf if is_by_name or config.max_change is None else float(config.max_change)
        change = np.where(self._is_speed, np.inf, every)
        for name, value in by_name.items():
            change[self.names.index(name)] = value
        self.max_change = change
        self._last: Vector | None = None

    @property
    def has_speeds(self) -> bool:
        """Whether any of the actions is a speed, with which a robot goes on until it gets another."""
        return bool(self._is_speed.any())

    def begin(self, measured: Vector) -> None:
        """Begin an episode from what the robot measures, shape (actions,); NaN where it does not.

        What grips still has its last position: measured is the thickness of what it holds.
        """
        first = np.where(self._is_speed & ~np.isfinite(measured), 0.0, measured)
        self._last = first if self._last is None else np.where(self._grips & ~self._is_speed, self._last, first)

    def holding(self) -> Vector:
        """Return the action that holds the robot: the last positions, no speed; NaN where nothing is known yet."""
        last = np.full(len(self.names), np.nan) if self._last is None else self._last
        return np.where(self._is_speed, 0.0, last)

    def stop(self, measured: Vector) -> Vector:
        """Return the action of an emergency stop, and remember it as the last one.

        Positions are those measured, within the range, or the last where none is; what grips keeps its last position,
        and with it what is gripped; there is no speed.
        """
        last = self.holding()
        inside = np.clip(measured, np.fmin(self.lower, last), np.fmax(self.upper, last))
        self._last = np.where(self._is_speed | self._grips | ~np.isfinite(measured), last, inside)
        return self._last

    def hold(self) -> Vector:
        """Return the action that holds the robot, as `holding`, and remember it as the last one."""
        self._last = self.holding()
        return self._last

    def passed(self, action: Vector) -> Passed:
        """Return what may be sent of an action, shape (actions,), and remember it as the last one."""
        last = np.full(len(self.names), np.nan) if self._last is None else self._last
        limits = 0
        finite = np.isfinite(action)
        if not finite.all():
            limits |= Limit.NON_FINITE
            action = np.where(finite, action, self.holding())
        inside = np.clip(action, self.lower, self.upper)
        if (inside != action)[finite].any():
            limits |= Limit.POSITION
        known = np.isfinite(last)
        low, high = (np.where(known, last + sign * self.max_change, sign * np.inf) for sign in (-1, 1))
        # From outside of the range it comes back at the allowed rate.
        near = np.clip(inside, low, high)
        if (near != inside)[np.isfinite(inside)].any():
            limits |= Limit.VELOCITY
        self._last = np.where(np.isfinite(near), near, last)
        return Passed(near, int(limits))

    def free_to_jump(self) -> list[str]:
        """Return the names of positions whose change from one frame to the next is not limited."""
        is_free = ~(self._is_speed | np.isfinite(self.max_change))
        return [name for name, free in zip(self.names, is_free, strict=True) if free]

    def unlimited(self) -> list[str]:
        """Return the names of actions whose range is not known."""
        is_limited = np.isfinite(self.lower) & np.isfinite(self.upper)
        return [name for name, limited in zip(self.names, is_limited, strict=True) if not limited]
