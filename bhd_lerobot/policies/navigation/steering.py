"""From free paths to a twist: which paths are free, and how one of them is driven."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.policies.navigation.clearance import QUANTUM, ClearanceTable, Level, Paths
from bhd_lerobot.policies.navigation.scan import ScanReader

Array = NDArray[np.float64]

_SPOT = 0.3  # [rad/s] a turn on the spot that is slower than this is a correction, and is driven while moving
_CAREFUL = 0.6  # share of the speed where there is less room than usual
_WEDGED = 4  # less free than this, in quanta, is no room to turn
_BACK_ROOM = 0.08  # [m] behind the robot, needed for backing off
_TIGHT = (Level(0.02, 0.02), Level(0.0, 0.01))
_NARROW = Level(0.02, 0.005)
NARROW = 4  # number of that level


class Freedom(NamedTuple):
    """What paths n robots have.

    Attributes:
        clear: how far each path is free, in `QUANTUM`, shape (n, K).
        free: whether that is enough, shape (n, K).
        level: which level of room that is for, 0 is the usual one, shape (n,).
    """

    clear: NDArray[np.uint8]
    free: NDArray[np.bool_]
    level: NDArray[np.intp]


class Steering:
    """Finds free paths, and drives one.

    Where no path leaves the usual room, it asks for less: enough to turn away from what is close already, and then for
    what remains.

    Args:
        paths: the paths.
        reader: reads the scans.
        margin: room that a path leaves beside the robot, where there is any [m].
        stop: a path must be free for this much more than its turn, so that the robot can turn around in time [m].
        limits: forward speed [m/s], speed of a wheel's rim [m/s], yaw rate [rad/s].
        settle: a heading error is corrected in about this time [s].
        range_max: the largest range that a scan shows [m].
        has_narrow: whether `narrow` is going to be called, which needs a table of its own.
    """

    def __init__(
        self,
        paths: Paths,
        reader: ScanReader,
        *,
        margin: float,
        stop: float,
        limits: tuple[float, float, float],
        settle: float,
        range_max: float,
        has_narrow: bool = True,
    ) -> None:
        self._paths, self._settle = paths, settle
        self._forward_speed, self._rim_speed, self._turn_speed = limits
        levels = (Level(margin, 0.005), Level(margin, 0.03), *_TIGHT, *((_NARROW,) if has_narrow else ()))
        beyond = np.array([stop, 0.1, 0.1, 0.1, 0.1])
        self._enough = np.ceil((paths.turn + beyond[:, None]) / QUANTUM).astype(np.int64)
        self._table = ClearanceTable(paths, reader.sectors, reader.spread, levels, range_max)

    def freedom(self, ranges: Array) -> Freedom:
        """Return what paths there are, given the nearest ranges of the sectors [m], shape (n, sectors)."""
        rows = self._table.rows(ranges)
        clear = self._table.clear(rows, 0)
        free = clear >= self._enough[0]
        level = np.zeros(len(ranges), np.intp)
        for tighter in range(1, NARROW):
            lost = np.flatnonzero(~free.any(axis=1))
            if len(lost):
                level[lost] = tighter
                clear[lost] = self._table.clear(rows[lost], tighter)
                free[lost] = clear[lost] >= self._enough[tighter]
        return Freedom(clear, free, level)

    def narrow(self, ranges: Array) -> Freedom:
        """Return what paths there are through narrow places, nothing coming nearer; otherwise like `freedom`."""
        clear = self._table.clear(self._table.rows(ranges), NARROW)
        return Freedom(clear, clear >= self._enough[NARROW], np.full(len(ranges), NARROW))

    def free_length(self, ranges: Array, path: NDArray[np.intp]) -> Array:
        """Return how far one path of each robot is free with little room beside it [m], shape (n,)."""
        clear = self._table.clear(self._table.rows(ranges), 2)
        return clear[np.arange(len(path)), path] * QUANTUM

    def choose(self, freedom: Freedom, cost: Array, turn_off: Array) -> NDArray[np.intp]:
        """Return the free path of least cost; where none is free, a turn on the spot as far as there is room.

        Args:
            freedom: what paths there are.
            cost: of the paths, shape (n, K).
            turn_off: angle between the paths and the heading chosen before [rad], shape (n, K).
        """
        spot = 3 * turn_off - 0.01 * freedom.clear + 100.0 * (self._paths.radius > 0)  # not back and forth
        return np.where(freedom.free, cost, spot + 1000.0).argmin(axis=1)

    def drive(
        self, freedom: Freedom, best: NDArray[np.intp], heading: Array, ranges: Array
    ) -> tuple[Array, Array, Array]:
        """Return how the chosen paths are driven.

        Args:
            freedom: what paths there are.
            best: the chosen ones, shape (n,).
            heading: direction to turn to, the path's own or one beside it [rad], shape (n,).
            ranges: nearest ranges of the sectors [m], shape (n, sectors).

        Returns:
            Forward speed [m/s], yaw rate [rad/s] and the heading [rad], each of shape (n,). A robot that is wedged,
            without even room to turn, backs off, and its heading is behind it.
        """
        sims = np.arange(len(best))
        moving, radius = freedom.free[sims, best], self._paths.radius[best]
        half_track = self._paths.footprint.half_track
        largest = np.where(radius > 0, self._rim_speed / (radius + half_track), self._turn_speed)
        turn = np.minimum(np.abs(heading) / self._settle, np.minimum(largest, self._turn_speed))
        forward = np.clip(self._rim_speed - half_track * turn, 0.0, self._forward_speed)
        forward *= np.where(freedom.level > 0, _CAREFUL, 1.0)
        forward = np.where(moving & ((radius > 0) | (turn < _SPOT)), forward, 0.0)
        wedged = ~moving & (freedom.clear[sims, best] <= _WEDGED) & (self._table.behind(ranges) > _BACK_ROOM)
        heading = np.where(wedged, math.pi, heading)
        forward = np.where(wedged, -_CAREFUL * self._forward_speed, forward)
        return forward, np.copysign(np.where(wedged, 0.0, turn), heading), heading


def wrap(angle: Array) -> Array:
    """Return angles in [-pi, pi) [rad]."""
    return (angle + math.pi) % (2 * math.pi) - math.pi


def keep_heading(before: Array, best: Array, within: float) -> Array:
    """Return the heading chosen before where it is near the best one, else that, all [rad], shape (n,).

    It lies between the headings that there are, and is kept while its neighbour is the best. A robot without one has
    NaN, and takes the best.
    """
    return np.where(np.abs(wrap(before - best)) <= within, before, best)
