"""A joint trajectory of ROS 2, sampled in time."""

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BPoly

from bhd_lerobot.control.messages import NANOSECONDS
from bhd_lerobot.errors import ActionError

_ORDERS = ("positions", "velocities", "accelerations")
_AT_REST = float(np.finfo(np.float32).eps)  # [rad/s], as joint_trajectory_controller has it


class JointTrajectory:
    """Positions of joints over time, as `joint_trajectory_controller` has them.

    Between two points they are linear, cubic where both have velocities, quintic where both have accelerations as well.

    Attributes:
        duration_s: when the last point is reached, since the trajectory's start [s].

    Args:
        start: where they are commanded to be now [rad], shape (joints,); it precedes the first point that is left.
        passed_s: how long ago the trajectory started [s]; the points up to then are left out.

    Raises:
        ActionError: the trajectory has other joints, no point, a point with a number of values that is not that of the
            joints, values that are not finite, times that do not rise, a velocity at its end, or is over.
    """

    def __init__(self, message: Any, joints: Sequence[str], start: NDArray[np.float64], passed_s: float = 0.0) -> None:
        names = list(message.joint_names)
        if sorted(names) != sorted(joints):
            raise ActionError(
                f"the trajectory has the joints {', '.join(names) or 'none'}; needed: {', '.join(joints)}"
            )
        if not message.points:
            raise ActionError("the trajectory has no point")
        order = [names.index(name) for name in joints]
        times = np.array([p.time_from_start.sec + p.time_from_start.nanosec / NANOSECONDS for p in message.points])
        points = [_derivatives(k, point, order) for k, point in enumerate(message.points)]
        if not (np.diff(times) > 0).all() or times[0] < 0:
            raise ActionError("the times of the trajectory's points do not rise from 0 on")
        if len(points[-1]) > 1 and (np.abs(points[-1][1]) > _AT_REST).any():
            raise ActionError(f"the velocities of the trajectory's last point are {points[-1][1].tolist()}, not 0")
        self.duration_s = float(times[-1])
        if self.duration_s < passed_s:
            raise ActionError(f"by its stamp the trajectory ended {passed_s - self.duration_s:.3g} s ago")
        self._last = points[-1][0]
        left = int(np.searchsorted(times, passed_s, side="right")) if passed_s > 0 else 0
        left = min(left, len(times) - 1)
        if times[left] > passed_s:
            times, points = np.append(passed_s, times[left:]), [np.stack([start, 0 * start, 0 * start]), *points[left:]]
        self._curve: Any = None
        if len(points) > 1:
            counts = [len(point) for point in points]
            orders = [2 * min(pair) - 1 for pair in itertools.pairwise(counts)]
            self._curve = BPoly.from_derivatives(times, points, orders)
        self._from_s = float(times[0])

    def at(self, time_s: float) -> NDArray[np.float64]:
        """Return the positions at a time since its start [rad], shape (joints,)."""
        if self._curve is None or time_s >= self.duration_s:
            return self._last
        sampled: NDArray[np.float64] = self._curve(max(self._from_s, time_s))
        return sampled


def _derivatives(number: int, point: Any, order: list[int]) -> NDArray[np.float64]:
    """Return a point's positions and what it has of their derivatives, in order, shape (derivatives, joints)."""
    values: list[NDArray[np.float64]] = []
    for name in (*_ORDERS, "effort"):
        given = getattr(point, name)
        if len(given) != len(order) and (len(given) or name == "positions"):
            raise ActionError(f"point {number} of the trajectory does not have {len(order)} {name}, but {len(given)}")
        if name in _ORDERS and not np.isfinite(given).all():
            raise ActionError(f"the {name} of point {number} of the trajectory have a value that is not finite")
        if len(given) and name == dict(enumerate(_ORDERS)).get(len(values)):
            values.append(np.asarray(given, np.float64)[order])
    return np.stack(values)
