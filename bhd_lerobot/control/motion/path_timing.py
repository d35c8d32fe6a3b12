"""How fast a given way of all joints is followed: nearly as fast as velocities, accelerations and jerks allow.

Along a path q(s), let b be the square of the path's speed and a = b' / 2 its acceleration. The joints' accelerations,
q' a + q'' b, are linear in b, and so are the squares of their velocities: that is time-optimal path parametrization (J.
Bobrow et al., IJRR 1985; H. Pham and Q.-C. Pham, T-RO 2018, for its peer TOPP-RA). Their jerks, the square root of b
times q' a' + 3 q'' a + q''' b, are too but for the root, which is taken from the solution before. So a few linear
programs, each with what the last came to, find a law that keeps all three.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline, CubicSpline, make_interp_spline
from scipy.optimize import linprog
from scipy.sparse import csr_matrix

Array = NDArray[np.float64]

_SEGMENTS = 40  # more are slower and gain a hundredth
_PROGRAMS = 7  # the first without jerks; more gain nothing
_START = 0.08  # of the way at either end, on which the speed is at most what the jerk gives from rest
_TINY = 1e-9


@dataclass(frozen=True)
class PathLimits:
    """What may not be exceeded on a path, each of shape (joints,); a joint without a limit has infinity."""

    velocity: Array
    acceleration: Array
    jerk: Array


@dataclass(frozen=True)
class PathTiming:
    """When a path is where.

    Attributes:
        share: share of the way over time, from rest at 0 to rest at 1.
        duration: when it ends [s].
    """

    share: BSpline
    duration: float


class PathTimer:
    """Finds the law of time of one path."""

    def __init__(self, path: CubicSpline, limits: PathLimits) -> None:
        self._path, self._limits = path, limits
        self._nodes = nodes = _nodes(path, limits.velocity)
        self._steps = steps = np.diff(nodes)
        self._middles = (nodes[1:] + nodes[:-1]) / 2
        slope = path(nodes, 1)
        self._slope, self._bend = slope[1:-1], path(nodes, 2)[1:-1]
        self._twist = np.diff(path(self._middles, 2), axis=0) / np.diff(self._middles)[:, None]
        # Of accelerations, constant on a segment, the shares of the squared speeds at its two ends.
        along, bend = path(self._middles, 1), path(self._middles, 2) / 2
        half = (0.5 / steps)[:, None]
        self._accelerations = (bend - along * half) / limits.acceleration, (bend + along * half) / limits.acceleration
        fastest = (limits.velocity / np.maximum(np.abs(slope), _TINY)).min(axis=1) ** 2
        fastest[[0, -1]] = 0.0
        self._fastest, self._from_rest = fastest, fastest.copy()
        self._jerks = (limits.jerk / np.maximum(np.abs(slope[[0, -1]]), _TINY)).min(axis=1)  # of the path, at its ends
        for jerk, way in zip(self._jerks, (nodes, 1.0 - nodes), strict=True):
            from_rest = (4.5 * jerk) ** (2 / 3) * way ** (4 / 3)  # s = j t^3 / 6
            np.minimum(self._from_rest, np.where(way < _START, from_rest, np.inf), out=self._from_rest)

    def bound(self) -> float | None:
        """Return how long the path takes without limits of the jerk, a lower bound for any law [s].

        None if no law keeps the limits.
        """
        return None if self._first is None else float(self._durations(self._first).sum())

    def find(self) -> PathTiming | None:
        """Return a law that keeps the limits, but for a little between the nodes; None if there is none."""
        squared = self._first
        acceleration, jerk = np.ones(len(self._steps)), np.ones(len(self._slope))
        for number in range(1, _PROGRAMS):
            if squared is None:
                return None
            squared = self._solve(squared, acceleration, jerk)
            if squared is not None and 2 < number < _PROGRAMS - 1:
                self._narrow(squared, acceleration, jerk)
        return None if squared is None else PathTiming(*self._law(squared))

    @cached_property
    def _first(self) -> Array | None:
        return self._solve(None, np.ones(len(self._steps)), np.ones(len(self._slope)))

    def _solve(self, before: Array | None, acceleration: Array, jerk: Array) -> Array | None:
        """Return the squared speeds at the nodes that a linear program finds.

        Args:
            before: those of the program before; None for the first, which knows no jerks.
        """
        low, high = self._accelerations
        segments = np.arange(len(self._steps))
        entries: list[tuple[Any, Any, Array]] = [
            ((segments, segments + 1), (low, high), acceleration[:, None] + 0 * low)
        ]
        if before is not None:
            limited = np.isfinite(self._limits.jerk)
            speed, jerks = np.sqrt(before[1:-1])[:, None], self._limits.jerk[limited]
            slope, bend = self._slope[:, limited] * speed / jerks, self._bend[:, limited] * speed / jerks
            twist = self._twist[:, limited] * speed / jerks
            change = slope / np.diff(self._middles)[:, None]
            left, right = 1.5 * bend - change, 1.5 * bend + change  # of the accelerations before and after a node
            half = (0.5 / self._steps)[:, None]
            columns = (segments[:-1], segments[:-1] + 1, segments[:-1] + 2)
            values = (-left * half[:-1], left * half[:-1] - right * half[1:] + twist, right * half[1:])
            entries.append((columns, values, jerk[:, None] + 0 * twist))
        rows, places, factors, most, first = [], [], [], [], 0
        for columns, values, limit in entries:
            for sign in (1.0, -1.0):
                number = first + np.arange(limit.size).reshape(limit.shape)
                first += limit.size
                for column, value in zip(columns, values, strict=True):
                    rows.append(number.ravel())
                    places.append(np.broadcast_to(column[:, None], limit.shape).ravel())
                    factors.append(sign * value.ravel())
                most.append(limit.ravel())
        matrix = csr_matrix(
            (np.concatenate(factors), (np.concatenate(rows), np.concatenate(places))), shape=(first, len(self._nodes))
        )
        gain, fastest = np.gradient(self._nodes), self._fastest
        if before is not None:  # how the duration falls with each of them
            fastest = self._from_rest
            gain *= np.maximum(before, 1e-3 * before.max()) ** -1.5
        answer: Any = linprog(  # type: ignore[call-overload]  # whose stubs know no sparse matrices
            -gain / gain.max(),
            A_ub=matrix,
            b_ub=np.concatenate(most),
            bounds=np.column_stack((np.zeros_like(fastest), fastest)),
            method="highs-ds",
        )
        return np.maximum(answer.x, 0.0) if answer.status == 0 else None

    def _narrow(self, squared: Array, acceleration: Array, jerk: Array) -> None:
        """Lower limits where the law between the nodes exceeds them, in place."""
        share, duration = self._law(squared)
        times: Array = np.linspace(0.0, duration, 8 * len(self._nodes), dtype=np.float64)
        _, _, accelerations, jerks = follow(self._path, share, times)
        at = np.clip(np.searchsorted(self._nodes, share(times)) - 1, 0, len(self._steps) - 1)
        most = np.full((2, len(self._steps)), _TINY)
        np.maximum.at(most[0], at, (np.abs(accelerations) / self._limits.acceleration).max(axis=1))
        np.maximum.at(most[1], at, (np.abs(jerks) / self._limits.jerk).max(axis=1))
        acceleration *= np.clip(most[0] ** -0.8, 0.6, 1.0)
        around = np.maximum(most[1, 1:], most[1, :-1])
        jerk *= np.clip(around**-0.8, 0.6, 1.0)
        for end, one in ((1, 0), (2, 1), (-2, -1), (-3, -2)):
            self._from_rest[end] *= np.clip(most[1, one] ** -0.6, 0.6, 1.0)

    def _durations(self, squared: Array) -> Array:
        """Return how long each segment takes with a constant acceleration [s]."""
        speed = np.sqrt(squared)
        return np.asarray(2 * self._steps / np.maximum(speed[1:] + speed[:-1], _TINY))

    def _law(self, squared: Array) -> tuple[BSpline, float]:
        durations = self._durations(squared)
        for end, speed in ((0, np.sqrt(squared[1])), (-1, np.sqrt(squared[-2]))):
            # From rest the acceleration comes first; with a constant jerk all the way it takes half as long again.
            later = speed**2 / (4 * self._steps[end] * self._jerks[end])
            durations[end] += min(later, durations[end] / 2)
        times = np.concatenate(((0.0,), np.cumsum(durations)))
        rest: Any = ([(1, 0.0), (2, 0.0)],) * 2  # velocity and acceleration at both ends
        return make_interp_spline(times, self._nodes, k=5, bc_type=rest), float(times[-1])


def follow(path: CubicSpline, share: BSpline, times: Array) -> tuple[Array, Array, Array, Array]:
    """Return positions, velocities, accelerations and jerks on a path at times, each of shape (times, joints)."""
    where, rate, change, jerk = np.clip(share(times), 0.0, 1.0), *(share(times, order)[:, None] for order in (1, 2, 3))
    slope, bend, twist = (path(where, order) for order in (1, 2, 3))
    return (
        path(where),
        slope * rate,
        bend * rate * rate + slope * change,
        twist * rate**3 + 3.0 * bend * rate * change + slope * jerk,
    )


def _nodes(path: CubicSpline, velocity: Array) -> Array:
    """Return shares of the way with as many of them where the joints turn far as where the way is long."""
    fine = np.linspace(0.0, 1.0, 20 * _SEGMENTS + 1)
    turning = (np.abs(path(fine, 1)) / velocity).max(axis=1)
    way = np.concatenate(((0.0,), np.cumsum(turning[1:] + turning[:-1])))
    nodes: Array = np.interp(np.linspace(0.0, 1.0, _SEGMENTS + 1), (way / way[-1] + fine) / 2, fine)
    nodes[0], nodes[-1] = 0.0, 1.0
    return nodes
