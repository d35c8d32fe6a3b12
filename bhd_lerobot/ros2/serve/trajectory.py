"""A joint trajectory of ROS 2, sampled in time."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline, make_interp_spline

from bhd_lerobot.control.messages import NANOSECONDS
from bhd_lerobot.errors import ActionError


class JointTrajectory:
    """Positions of joints over time: between points cubic where they have speeds, linear where they have none.

    Attributes:
        duration_s: when the last point is reached [s].

    Args:
        message: a `trajectory_msgs/msg/JointTrajectory`.
        joints: the robot's joints, as ROS has them, in its order.
        start: where they are commanded to be now [rad], shape (joints,); the first point is preceded by it.

    Raises:
        ActionError: the trajectory has other joints, no point, values that are not finite, or times that do not rise.
    """

    def __init__(self, message: Any, joints: Sequence[str], start: NDArray[np.float64]) -> None:
        names = list(message.joint_names)
        if sorted(names) != sorted(joints):
            raise ActionError(
                f"the trajectory has the joints {', '.join(names) or 'none'}; needed: {', '.join(joints)}"
            )
        points = list(message.points)
        if not points:
            raise ActionError("the trajectory has no point")
        order = [names.index(name) for name in joints]
        times = np.array([p.time_from_start.sec + p.time_from_start.nanosec / NANOSECONDS for p in points])
        if any(len(point.positions) != len(joints) for point in points):
            raise ActionError(f"a point of the trajectory does not have {len(joints)} positions")
        positions = np.array([point.positions for point in points])[:, order]
        with_speeds = all(len(point.velocities) == len(joints) for point in points)
        speeds = np.array([point.velocities for point in points])[:, order] if with_speeds else None
        if times[0] > 0:
            times, positions = np.append(0.0, times), np.vstack([start, positions])
            speeds = None if speeds is None else np.vstack([np.zeros(len(joints)), speeds])
        if not (np.isfinite(positions).all() and (speeds is None or np.isfinite(speeds).all())):
            raise ActionError("the trajectory has a value that is not finite")
        if not (np.diff(times) > 0).all() or times[0] < 0:
            raise ActionError("the times of the trajectory's points do not rise from 0 on")
        self.duration_s = float(times[-1])
        self._last = positions[-1]
        self._curve: Any = None
        if len(times) > 1:
            curve: Any = make_interp_spline(times, positions, 1)
            self._curve = curve if speeds is None else CubicHermiteSpline(times, np.asarray(positions), speeds)

    def at(self, time_s: float) -> NDArray[np.float64]:
        """Return the positions at a time since its start [rad], shape (joints,)."""
        if self._curve is None or time_s >= self.duration_s:
            return self._last
        sampled: NDArray[np.float64] = self._curve(max(0.0, time_s))
        return sampled
