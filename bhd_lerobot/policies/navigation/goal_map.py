"""What was seen of the surroundings, around the goal, and the ways that lead there.

The map lies still in the goal's frame: as the robots know where the goal is, they know where they are in it, and
nothing drifts. What was never seen counts as free, and a way is planned again when something seen newly is in it, the
setting of D* Lite (S. Koenig and M. Likhachev, "D* Lite", AAAI 2002).
"""

import math
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

Array = NDArray[np.float64]

CELL = 0.05  # [m] edge length of a cell
_HALF = 200  # cells from the goal to the map's border
_SIDE = 2 * _HALF + 1
_AROUND = 12  # cells beyond all that was seen, in which ways are searched
_UNIT = 0.001  # [m] of the stored lengths
_FAR = 65535  # nothing known
# [m] beside the robot, from something seen:
_BLOCKED_M = (0.046, 0.011)  # no way; the second where there is none else
_ROOM_M = 0.211  # a way begins to be dearer
_STEEP = 3.0  # what it costs in addition where it is blocked
_END_CELLS = 3  # around the robot and the goal, that count as free
_ALARM_M = 0.061  # [m] beside the robot, something seen newly is in its way
_OFF = 10.0  # what leaving the places with a way costs, per metre
_STEPS = ((0, 1), (1, 0), (1, 1), (1, -1), (1, 2), (2, 1), (1, -2), (2, -1))


class GoalMap:
    """Maps of n robots.

    Args:
        n: how many.
        half_width: of a robot [m].
    """

    def __init__(self, n: int, half_width: float = 0.089) -> None:
        self._blocked = [round(half_width + beside, 6) for beside in _BLOCKED_M]
        self._room, self._alarm = round(half_width + _ROOM_M, 6), round(half_width + _ALARM_M, 6)
        self._seen = np.zeros((n, _SIDE, _SIDE), np.bool_)
        self._way = np.zeros((n, _SIDE, _SIDE), np.bool_)  # places that a new obstacle must not be in
        self._left = np.full((n, _SIDE, _SIDE), _FAR, np.uint16)
        # Bounds of what was seen, in cells: first and last row, first and last column.
        self._bounds = np.tile([_HALF, _HALF, _HALF, _HALF], (n, 1))
        self._offset = np.arange(n) * (_SIDE * _SIDE)
        self.news = np.zeros(n, np.int64)
        """Number of cells seen occupied for the first time since the last plan, shape (n,)."""
        self.blocked = np.ones(n, np.bool_)
        """Whether one of them is in the way, or there is none yet, shape (n,)."""

    def forget(self, ids: NDArray[np.intp]) -> None:
        """Forget everything in some maps."""
        self._seen[ids] = self._way[ids] = False
        self._left[ids] = _FAR
        self._bounds[ids] = _HALF
        self.news[ids] = 0
        self.blocked[ids] = True

    def mark(self, x: Array, y: Array, seen: NDArray[np.bool_]) -> None:
        """Mark obstacles.

        Args:
            x: where they are, in the goal's frame [m], shape (n, points).
            y: likewise.
            seen: which of them are any, shape (n, points).
        """
        row, column, inside = _cells(x, y)
        sim, point = np.nonzero(seen & inside)
        row, column = row[sim, point], column[sim, point]
        new = ~self._seen[sim, row, column]
        sim, row, column = sim[new], row[new], column[new]
        self._seen[sim, row, column] = True
        np.add.at(self.news, sim, 1)
        self.blocked[sim[self._way[sim, row, column]]] = True
        np.minimum.at(self._bounds[:, 0], sim, row)
        np.maximum.at(self._bounds[:, 1], sim, row)
        np.minimum.at(self._bounds[:, 2], sim, column)
        np.maximum.at(self._bounds[:, 3], sim, column)

    def way_left(self, x: NDArray, y: NDArray) -> NDArray[np.float32]:
        """Return the lengths of the ways to the goal from some places [m].

        Where there is little room a way counts as longer. Where none is known, it is the straight distance and much.

        Args:
            x: the places in the goal's frame [m], shape (n, ...).
            y: likewise.
        """
        row, column, inside = _cells(x, y)
        cell = row * _SIDE + column + self._offset.reshape(-1, *(1,) * (x.ndim - 1))
        left = self._left.ravel().take(cell)
        known = inside & (left < _FAR)
        return np.where(known, left * np.float32(_UNIT), np.hypot(x, y).astype(np.float32) + np.float32(_FAR * _UNIT))

    def plan(self, sim: int, x: float, y: float) -> bool:
        """Find the ways to the goal in one map; return whether there is one from the robot's place [m]."""
        self.news[sim] = 0
        self.blocked[sim] = False
        self._way[sim] = False
        self._left[sim] = _FAR
        if not max(abs(x), abs(y)) < (_HALF - _AROUND) * CELL:
            return False
        row, column = (int(np.rint(value / CELL)) + _HALF for value in (y, x))
        first_row, last_row, first_column, last_column = self._bounds[sim].tolist()
        top, left = max(0, min(first_row, row) - _AROUND), max(0, min(first_column, column) - _AROUND)
        bottom, right = max(last_row, row) + _AROUND + 1, max(last_column, column) + _AROUND + 1
        box = (sim, slice(top, bottom), slice(left, right))
        seen = self._seen[box]
        room = scipy.ndimage.distance_transform_edt(~seen) * CELL if seen.any() else np.full(seen.shape, np.inf)
        shape, width = seen.shape, seen.shape[1]
        start, goal = (row - top) * width + column - left, (_HALF - top) * width + _HALF - left
        # Where the robot and the goal are, there must be room enough, whatever was seen.
        rows, columns = np.ogrid[top : top + shape[0], left : left + width]
        ends: NDArray[np.bool_] = np.zeros(shape, np.bool_)
        for at_row, at_column in ((row, column), (_HALF, _HALF)):
            ends |= ((rows - at_row) ** 2 + (columns - at_column) ** 2 <= _END_CELLS**2) & ~seen
        price = 1.0 + _STEEP * np.clip((self._room - room) / (self._room - self._blocked[1]), 0.0, 1.0)
        for blocked in self._blocked:
            graph = _graph(ends | (room > blocked), price)
            lengths, before = scipy.sparse.csgraph.dijkstra(
                graph, directed=False, indices=goal, return_predecessors=True
            )
            if np.isfinite(lengths[start]):
                break
        lengths = lengths.reshape(shape)
        found = np.isfinite(lengths)
        away, (near_row, near_column) = scipy.ndimage.distance_transform_edt(~found, return_indices=True)
        lengths = (lengths[near_row, near_column] + away * _OFF) * CELL
        self._left[box] = np.minimum(lengths / _UNIT, _FAR - 1)
        if not found.ravel()[start]:
            return False
        way = np.zeros(seen.size, np.bool_)
        cell = start
        while cell >= 0:
            way[cell] = True
            cell = before[cell]
        self._way[box] = scipy.ndimage.distance_transform_edt(~way.reshape(shape)) * CELL <= self._alarm
        return True


def _cells(x: NDArray, y: NDArray) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.bool_]]:
    """Return rows and columns of places, and whether they are in the map."""
    # Rounded, not cut off: to the left and to the right alike.
    column, row = (np.rint(np.clip(value * (1 / CELL), -_SIDE, _SIDE)).astype(np.int32) + _HALF for value in (x, y))
    inside = (row >= 0) & (row < _SIDE) & (column >= 0) & (column < _SIDE)
    return np.where(inside, row, 0), np.where(inside, column, 0), inside


def _graph(free: NDArray[np.bool_], price: Array) -> Any:
    """Return the steps between free cells, with their lengths [cells] times the mean price at their ends."""
    rows, columns = free.shape
    number = np.arange(free.size, dtype=np.int32).reshape(rows, columns)
    border = np.pad(free, 2)
    starts, ends, lengths = [], [], []
    for row, column in _STEPS:
        possible = free & border[2 + row : 2 + row + rows, 2 + column : 2 + column + columns]
        start = number[possible]
        end = start + (row * columns + column)
        starts.append(start)
        ends.append(end)
        flat = price.ravel()
        lengths.append(math.hypot(row, column) * 0.5 * (flat[start] + flat[end]))
    edges = (np.concatenate(lengths), (np.concatenate(starts), np.concatenate(ends)))
    return scipy.sparse.csr_array(edges, shape=(free.size, free.size))
