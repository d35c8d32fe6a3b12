"""The lengths of the shortest ways to a place in an arena."""

import numpy as np
import scipy
from numpy.typing import NDArray

from bhd_lerobot.bodies.arenas import RESOLUTION, Arena

# A step leads to one of sixteen neighbours, of which eight are listed; the other eight lead back. Beside each the cells
# that it passes, all of which must be free: without a diagonal squeeze, what hangs together is what `Arena.reachable`
# says. With sixteen directions a way is at most 2.8 % longer than the straight line that it stands for.
_STEPS: tuple[tuple[tuple[int, int], tuple[tuple[int, int], ...]], ...] = (
    ((0, 1), ()),
    ((1, 0), ()),
    ((1, 1), ((0, 1), (1, 0))),
    ((1, -1), ((0, -1), (1, 0))),
    ((1, 2), ((0, 1), (1, 1))),
    ((2, 1), ((1, 0), (1, 1))),
    ((1, -2), ((0, -1), (1, -1))),
    ((2, -1), ((1, 0), (1, -1))),
)
_REACH = 2  # cells that a step goes at most


def way_lengths(free: NDArray[np.bool_], goal: tuple[int, int]) -> NDArray[np.float64]:
    """Return the length of the shortest way from each cell of a grid to a goal [cells], infinite where there is none.

    Args:
        free: cells that a way may lead through, shape (rows, columns).
        goal: row and column.
    """
    rows, columns = free.shape
    numbers = np.arange(free.size).reshape(rows, columns)
    border = np.pad(free, _REACH)

    def at(row: int, column: int) -> NDArray[np.bool_]:
        return border[_REACH + row : _REACH + row + rows, _REACH + column : _REACH + column + columns]

    starts, ends, lengths = [], [], []
    for (row, column), passed in _STEPS:
        possible = free & at(row, column)
        for cell in passed:
            possible &= at(*cell)
        start = numbers[possible]
        starts.append(start)
        ends.append(start + row * columns + column)
        lengths.append(np.full(len(start), np.hypot(row, column)))
    edges = (np.concatenate(lengths), (np.concatenate(starts), np.concatenate(ends)))
    graph = scipy.sparse.coo_array(edges, shape=(free.size, free.size)).tocsr()
    found: NDArray[np.float64] = scipy.sparse.csgraph.dijkstra(
        graph, directed=False, indices=goal[0] * columns + goal[1]
    )
    return found.reshape(rows, columns)


class WayField:
    """The shortest ways to a place in an arena, on the arena's grid of places that the robot's centre can get to.

    Attributes:
        origin: x and y of the first grid point [m], world frame.
        lengths: of the ways from the grid points [m], shape (rows, columns). A point that the robot's centre cannot get
            to has the length of the nearest one that it can, and the distance to there.
        is_way: whether there is a way from each grid point, shape (rows, columns).

    Args:
        arena: the arena.
        place: x and y [m], world frame.
    """

    def __init__(self, arena: Arena, place: tuple[float, float]) -> None:
        points, free = arena.reachable
        self.origin = points[0, 0].copy()
        row, column = nearest_cell(arena, place)
        apart = float(np.hypot(*(points[row, column] - place)))
        lengths = way_lengths(free, (row, column)) * RESOLUTION + apart
        self.is_way = np.isfinite(lengths)
        if self.is_way.any():
            away, (rows, columns) = scipy.ndimage.distance_transform_edt(~self.is_way, return_indices=True)
            lengths = lengths[rows, columns] + away * RESOLUTION
        self.lengths: NDArray[np.float64] = lengths


def nearest_cell(arena: Arena, place: tuple[float, float]) -> tuple[int, int]:
    """Return row and column of the grid point of an arena that is nearest to a place (x, y) [m]."""
    points, _ = arena.reachable
    x, y = points[0, 0]
    rows, columns = points.shape[:2]
    row, column = round((place[1] - y) / RESOLUTION), round((place[0] - x) / RESOLUTION)
    return min(max(row, 0), rows - 1), min(max(column, 0), columns - 1)


def interpolate(fields: NDArray[np.float64], origin: NDArray[np.float64], xy: NDArray[np.float64]) -> NDArray:
    """Return the values of n fields at a place in each, between the grid points linear.

    Args:
        fields: shape (n, rows, columns).
        origin: x and y of the first grid points [m], shape (n, 2).
        xy: the places [m], shape (n, 2).

    Returns:
        The values, shape (n,)
    """
    n, rows, columns = fields.shape
    at = np.clip((xy - origin) / RESOLUTION, 0.0, np.array([columns - 1.0, rows - 1.0]))
    column, row = np.minimum(at.astype(np.int64), (max(columns - 2, 0), max(rows - 2, 0))).T
    right, up = at[:, 0] - column, at[:, 1] - row
    sims = np.arange(n)
    low = fields[sims, row, column] * (1 - right) + fields[sims, row, column + 1] * right
    high = fields[sims, row + 1, column] * (1 - right) + fields[sims, row + 1, column + 1] * right
    return low * (1 - up) + high * up
