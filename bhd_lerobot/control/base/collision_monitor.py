"""Keeps bases from driving into what their scans show, whatever commands them."""

import math

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Drive, LidarSpec

MARGIN = 0.02  # [m] beside the robot's outline: twice the noise of an LDS-01
_DELAY_S = 0.03  # from a measurement to wheels that brake: two ticks and the servos' time constant, 11 ms
# Of the stopping deceleration. The rest is for what turning adds: 0.22 m/s times 2.84 rad/s bring a return that was
# beside the robot nearer with 0.6 m/s^2.
_SHARE = 0.5
_NEVER = 1e-9
_BESIDE_DEG = 3.0  # two directions that are no farther apart show the same thing
_OLDEST_SCANS = 3  # a scan that is older than so many periods shows nothing of the present


class CollisionMonitor:
    """Limits what n bases are commanded, so that each can brake before it gets to what its scan shows.

    The speed at which a return comes nearer to the robot's outline may be no larger than what can be braked on the way
    that is left; what leads away from it is free. Yaw rates come first, because turning is what avoids an obstacle, and
    are limited where a corner would sweep over something. Returns stay where they were seen, by odometry, until the
    next scan, and those that have come too near to be measured for as long as they are. Without a scan of the last
    three periods a base does not move.

    It knows what the lidar sees: nothing below or above its plane, nothing thinner than two beams are apart, and what
    moves only where it was.

    Args:
        drive: limits, radius and outline.
        lidar: the lidar.
        n: number of bases.
        control_hz: ticks a second [Hz].
        beams: ranges in a scan, counter-clockwise from ahead.
    """

    def __init__(self, drive: Drive, lidar: LidarSpec, n: int, control_hz: int, beams: int) -> None:
        self.beams = beams
        angle = 2 * np.pi * np.arange(beams) / beams
        self._directions, self._ahead = np.stack([np.cos(angle), np.sin(angle)], axis=-1), lidar.ahead
        self._range_min, self._range_max = lidar.range_min, lidar.range_max
        fastest = drive.limits.velocity[0]
        self._deceleration = _SHARE * drive.limits.stop_deceleration[0]
        self._largest_change = np.asarray(drive.limits.stop_deceleration) / control_hz
        self._outline = drive.outline
        self._oldest_ticks = round(_OLDEST_SCANS * control_hz / lidar.rate_hz)
        way = fastest * (_OLDEST_SCANS / lidar.rate_hz + _DELAY_S) + fastest**2 / (2 * self._deceleration)
        self._reach = drive.radius + MARGIN + way  # what is farther cannot matter before the scan is too old
        self._near: list[NDArray[np.float64]] = [np.zeros((0, 2))] * n  # returns in the frame of the odometry [m]
        self._too_near: list[NDArray[np.bool_]] = [np.zeros(0, np.bool_)] * n  # nearer than the lidar can measure
        width = round(math.radians(_BESIDE_DEG) / (2 * np.pi) * beams)
        self._beside = np.arange(-width, width + 1)
        self._hidden: NDArray[np.bool_] = np.zeros(0, np.bool_)
        self._points: NDArray[np.float64] = np.zeros((0, 2))
        self._sims: NDArray[np.intp] = np.zeros(0, np.intp)
        self._seen_ns = np.full(n, -1, np.int64)
        self._age = np.full(n, self._oldest_ticks + 1)  # [ticks]

    def forget(self, ids: NDArray[np.intp]) -> None:
        """Forget the scans of bases that were put somewhere else."""
        for sim in ids:
            self._near[sim], self._too_near[sim] = np.zeros((0, 2)), np.zeros(0, np.bool_)
        self._seen_ns[ids] = -1
        self._age[ids] = self._oldest_ticks + 1

    def see(
        self,
        ranges: NDArray[np.float64],
        stamp_ns: NDArray[np.int64],
        pose: NDArray[np.float64],
        age: NDArray[np.int64] | None = None,
    ) -> None:
        """Take what was measured since the last tick.

        Args:
            ranges: the newest scan [m], shape (n, beams).
            stamp_ns: when it was taken: one that is not new is not taken again, shape (n,).
            pose: x, y [m] and yaw [rad] of the bases when it was taken, by odometry, shape (n, 3).
            age: how many ticks ago that was, shape (n,); none if None.
        """
        self._age += 1
        new = stamp_ns != self._seen_ns
        if not np.count_nonzero(new):
            return
        for sim in np.flatnonzero(new):
            old = 0 if age is None else int(age[sim])
            # A scan that is no measurement, or from the future, is not taken: the last gets old, and the base stops.
            if old >= -1 and np.isfinite(ranges[sim]).all():
                self._seen_ns[sim], self._age[sim] = stamp_ns[sim], max(old, 0)
                self._keep(sim, ranges[sim], pose[sim])
        self._points, self._hidden = np.concatenate(self._near), np.concatenate(self._too_near)
        self._sims = np.repeat(np.arange(len(self._near)), [len(near) for near in self._near])

    def _keep(self, sim: int, scan: NDArray[np.float64], pose: NDArray[np.float64]) -> None:
        """Remember the near returns of a scan, and those of the last which have come too near to be measured."""
        cos, sin = np.cos(pose[2]), np.sin(pose[2])
        to_world, middle = np.array([[cos, sin], [-sin, cos]]), pose[:2]
        hidden = scan <= self._range_min
        near = (scan < min(self._reach + abs(self._ahead), self._range_max)) & ~hidden
        points = [self._ahead_of(scan[near, None] * self._directions[near])]
        unknown: NDArray[np.float64] = np.zeros((0, 2))
        if np.count_nonzero(hidden):
            last = self._near[sim][~self._too_near[sim]]
            seen: NDArray[np.float64] = (last - middle) @ to_world.T - (self._ahead, 0.0)
            beam = np.rint(np.arctan2(seen[:, 1], seen[:, 0]) / (2 * np.pi) * self.beams).astype(np.int64)
            around = (beam[:, None] + self._beside) % self.beams
            kept = hidden[around].any(axis=1)
            points.append(self._ahead_of(seen[kept]))
            hidden[around[kept]] = False
            unknown = self._ahead_of(scan[hidden, None] * self._directions[hidden])
        both: NDArray[np.float64] = np.concatenate([*points, unknown]) @ to_world + middle
        self._near[sim] = both
        self._too_near[sim] = np.arange(len(both)) >= len(both) - len(unknown)

    def _ahead_of(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        return points + np.array((self._ahead, 0.0))

    def limit(
        self, twist: NDArray[np.float64], before: NDArray[np.float64], pose: NDArray[np.float64]
    ) -> NDArray[np.bool_] | None:
        """Take away speed and yaw rate, in place.

        Args:
            twist: forward speeds [m/s] and yaw rates [rad/s] to be applied, shape (n, 2).
            before: what was applied a tick ago, shape (n, 2).
            pose: x, y [m] and yaw [rad] of the bases now, by odometry, shape (n, 3).

        Returns:
            What was limited, shape (n, 2); None if nothing was.
        """
        room = np.full((2, 2, len(twist)), np.inf)  # speeds, yaw rates; up, down
        if len(self._points):
            self._measure(twist, pose, room)
        room[:, :, self._age > self._oldest_ticks] = 0.0
        # No harder than a stop: what appears nearer than that is not avoided.
        limited = np.minimum(twist, np.maximum(room[:, 0].T, before - self._largest_change))
        np.maximum(limited, np.minimum(-room[:, 1].T, before + self._largest_change), out=limited)
        changed: NDArray[np.bool_] = limited != twist
        if not np.count_nonzero(changed):
            return None
        twist[:] = limited
        return changed

    def _measure(
        self,
        twist: NDArray[np.float64],
        pose: NDArray[np.float64],
        room: NDArray[np.float64],
    ) -> None:
        """Lower the largest speeds and yaw rates to what the returns leave; see `limit`.

        A return whose nearest point of the outline is `normal` away comes nearer by normal[0] per metre that is driven,
        and by `lever` per radian that is turned.
        """
        sims = self._sims
        x, y, yaw = pose.T[:, sims]
        cos, sin = np.cos(yaw), np.sin(yaw)
        apart = self._points[:, 0] - x, self._points[:, 1] - y
        ahead, left = apart[0] * cos + apart[1] * sin, apart[1] * cos - apart[0] * sin
        normal, distance = self._from_outline(ahead, left)
        lever = normal[1] * ahead - normal[0] * left
        way = np.maximum(distance - MARGIN, 0.0)
        way[self._hidden] = 0.0
        # The largest v with v * delay + v^2 / (2 deceleration) = way.
        slope = self._deceleration * _DELAY_S
        speed = np.sqrt(slope**2 + 2.0 * self._deceleration * way) - slope
        for up, sign in enumerate((1.0, -1.0)):
            np.minimum.at(room[1, up], sims, speed / np.maximum(sign * lever, _NEVER))
        # Turning comes first: it is what avoids an obstacle. What it leaves is for driving.
        yaw_rate = np.minimum(np.maximum(twist[:, 1], -room[1, 1]), room[1, 0])[sims]
        speed -= lever * yaw_rate
        np.maximum(speed, 0.0, out=speed)
        for up, sign in enumerate((1.0, -1.0)):
            np.minimum.at(room[0, up], sims, speed / np.maximum(sign * normal[0], _NEVER))

    def _from_outline(
        self, ahead: NDArray[np.float64], left: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the directions from the outline to points, shape (2, points), and their distances, shape (points,)."""
        normal, distance = np.zeros((2, len(ahead))), np.full(len(ahead), np.inf)
        for rear, front, half in self._outline:
            dx = ahead - np.minimum(np.maximum(ahead, rear), front)
            dy = left - np.minimum(np.maximum(left, -half), half)
            apart = np.hypot(dx, dy)
            nearer = apart < distance
            np.copyto(distance, apart, where=nearer)
            np.copyto(normal[0], dx, where=nearer)
            np.copyto(normal[1], dy, where=nearer)
        # Inside there is no direction out of it: away from the middle.
        inside = distance < 1e-6
        normal[:, inside] = ahead[inside], left[inside]
        normal /= np.maximum(np.hypot(*normal), 1e-6)
        return normal, distance
