"""Where a base roams: the `turtlebot3_world` layout and a seeded generator of arenas.

Every arena is closed, all of it that the robot's centre can be in is connected, and the start pose is free.
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Shape
from bhd_lerobot.errors import ConfigError, unknown_name
from bhd_lerobot.options.registry import Registry

BURGER_RADIUS = 0.124  # [m] of the TurtleBot3 Burger around its wheel axis, as in bodies/turtlebot3.py
CLEARANCE = 0.051  # [m] what must be free beside the robot for a place to count as reachable
RESOLUTION = 0.05  # [m] of the grid that reachability is computed on
START_CLEARANCE = 0.35  # [m] from the robot's centre to the nearest obstacle at the start
WALL = 0.05  # [m] half the thickness of the outer walls
_NEXT = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], np.bool_)  # neighbours of a place of the grid


@dataclass(frozen=True)
class Arena:
    """Obstacles, extent and start of an episode.

    Attributes:
        name: which layout it is.
        shapes: all obstacles, outer walls included.
        extent: x_min, x_max, y_min, y_max of the inside [m].
        start: x [m], y [m], yaw [rad] of the robot, world frame.
        goal: likewise, where a task sends the robot.
        robot_radius: of the robot that is to get through [m].
        report_seed: of the noise on what the task senses, where there is any.
    """

    name: str
    shapes: tuple[Shape, ...]
    extent: tuple[float, float, float, float]
    start: tuple[float, float, float]
    goal: tuple[float, float, float] | None = None
    robot_radius: float = BURGER_RADIUS
    report_seed: int = 0

    def clearance(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the distance from points to the nearest obstacle [m], negative inside one.

        Args:
            points: x and y in the world frame [m], shape (..., 2).
        """
        return _clearance(self.shapes, points[..., 0], points[..., 1])

    @cached_property
    def reachable(self) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Grid points (rows, columns, 2) [m], and whether the robot's centre can get to each from the start."""
        x, y = _axes(self.extent)
        return _points(x, y), self._reached(_clearance(self.shapes, x, y))

    def _reached(self, clearance: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return where the robot's centre can get to from the start, on the grid that the clearance is of."""
        labels, _ = scipy.ndimage.label(clearance > self.robot_radius + CLEARANCE, _NEXT)
        row, column = _nearest(self.extent, self.start[:2])
        label = labels[row, column]
        reached: NDArray[np.bool_] = (labels == label) & (label > 0)
        return reached

    def cell_of(self, points: NDArray[np.float64], size: float) -> NDArray[np.int64]:
        """Return the number of the square cell that each point lies in, shape (...,).

        Args:
            points: x and y in the world frame [m], shape (..., 2).
            size: edge length of a cell [m].
        """
        x_min, _, y_min, _ = self.extent
        columns, rows = self.cells(size)
        column = np.clip(np.floor((points[..., 0] - x_min) / size), 0, columns - 1).astype(np.int64)
        row = np.clip(np.floor((points[..., 1] - y_min) / size), 0, rows - 1).astype(np.int64)
        return row * columns + column

    def cells(self, size: float) -> tuple[int, int]:
        """Return how many cells of this edge length [m] cover the extent: columns along x, rows along y."""
        x_min, x_max, y_min, y_max = self.extent
        return max(1, math.ceil((x_max - x_min) / size - 1e-9)), max(1, math.ceil((y_max - y_min) / size - 1e-9))

    def free_cells(self, size: float) -> NDArray[np.int64]:
        """Return the numbers of the cells that the robot's centre can get into, sorted."""
        points, free = self.reachable
        columns, rows = self.cells(size)
        is_free = np.zeros(columns * rows, np.bool_)
        is_free[self.cell_of(points[free], size)] = True
        return np.flatnonzero(is_free)


def make_arena(name: str, seed: int, random_start: bool = False, *, robot_radius: float = BURGER_RADIUS) -> Arena:
    """Return an arena by name.

    Args:
        name: one of `ARENAS`.
        seed: decides everything about a random arena, and the start pose where it is random.
        random_start: start at a random free pose, not at the layout's own; a random arena always does.
        robot_radius: of the robot that is to get through [m].

    Raises:
        ConfigError: there is no such arena.
    """
    if name not in ARENAS:
        raise ConfigError(unknown_name("arena", name, ARENAS))
    arena = ARENAS[name](seed, robot_radius)
    if arena.robot_radius != robot_radius:
        arena = replace(arena, robot_radius=robot_radius)
    return _with_random_start(arena, seed) if random_start and name != "random" else arena


def register_arena(name: str, make: Callable[[int, float], Arena]) -> None:
    """Add an arena to those that robots and tasks can choose by name.

    Args:
        name: its name.
        make: makes it, given a seed and the radius of the robot [m]: equal seeds must give equal arenas.

    Raises:
        ConfigError: another arena has this name.
    """
    ARENAS.register(name, make)


def turtlebot3_world() -> Arena:
    """Return the layout of ROBOTIS' `turtlebot3_world`.

    Nine cylinders of radius 0.15 m on a 1.1 m grid, a hexagonal wall around them, start at (-2.0, -0.5) facing +x, as
    in `turtlebot3_gazebo`. The wall is a mesh there; its size here is an estimate.
    """
    shapes = [Shape("cylinder", 1.1 * i, 1.1 * j, 0.0, 0.15, 0.15) for i in (-1, 0, 1) for j in (-1, 0, 1)]
    radius = 2.9  # of the corners; two of them on the x axis
    apothem = radius * math.cos(math.pi / 6)
    for side in range(6):
        angle = math.pi / 6 + side * math.pi / 3
        distance = apothem + WALL
        shapes.append(
            Shape("box", distance * math.cos(angle), distance * math.sin(angle), angle, WALL, radius / 2 + WALL)
        )
    return Arena("turtlebot3_world", tuple(shapes), (-radius, radius, -apothem, apothem), (-2.0, -0.5, 0.0))


def random_arena(seed: int, robot_radius: float = BURGER_RADIUS) -> Arena:
    """Return a random rectangular arena with cylinders, boxes, walls, corridors and dead ends.

    Args:
        seed: any whole number from 0; equal seeds give equal arenas.
        robot_radius: of the robot that is to get through [m].
    """
    room = robot_radius + CLEARANCE
    start_room = max(START_CLEARANCE, room)
    rng = np.random.default_rng(np.random.SeedSequence([0xA2E4A, int(seed)]))
    for _ in range(1000):
        half_x, half_y = rng.uniform(1.8, 3.0, size=2)
        obstacles: list[Shape] = []
        x, y = _axes((-half_x, half_x, -half_y, half_y))
        clearance = _clearance(outer_walls(half_x, half_y), x, y)
        free = clearance > room
        builders = (_cylinders, _boxes, _walls, _corridor, _dead_end)
        # Each arena has its own mixture: some are forests of posts, some mazes.
        for builder, count in zip(builders, rng.integers((2, 1, 0, 0, 0), (9, 6, 4, 2, 3)), strict=True):
            for _ in range(count):
                group = builder(rng, half_x, half_y)
                trial = _closer(clearance, group, x, y)
                left = trial > room
                # Not crowded: at least a third of the floor stays free for the robot's centre.
                if np.count_nonzero(left) / left.size > 1 / 3 and _stays_connected(free, left):
                    obstacles += group
                    clearance, free = trial, left
        if (clearance > start_room).any():
            points = _points(x, y)
            start = _random_pose(points, clearance > start_room, rng)
            arena = replace(_closed("random", half_x, half_y, obstacles, start), robot_radius=robot_radius)
            # The cached property's value, which whoever draws an arena asks for: its clearance is known already.
            vars(arena)["reachable"] = points, arena._reached(clearance)
            return arena
    raise ConfigError(f"No arena could be generated from seed {seed}.")  # 1000 failures in a row


def _empty() -> Arena:
    return _closed("empty", 3.0, 3.0, [], (0.0, 0.0, 0.0))


def _with_random_start(arena: Arena, seed: int) -> Arena:
    rng = np.random.default_rng(np.random.SeedSequence([0x57A27, int(seed)]))
    points, reachable = arena.reachable
    room = max(START_CLEARANCE, arena.robot_radius + CLEARANCE)
    return replace(arena, start=_random_pose(points, reachable & (arena.clearance(points) > room), rng))


def _random_pose(
    points: NDArray[np.float64], is_free: NDArray[np.bool_], rng: np.random.Generator
) -> tuple[float, float, float]:
    candidates = points[is_free]
    x, y = candidates[rng.integers(len(candidates))]
    return float(x), float(y), float(rng.uniform(-np.pi, np.pi))


def _closed(
    name: str, half_x: float, half_y: float, obstacles: list[Shape], start: tuple[float, float, float]
) -> Arena:
    shapes = tuple(outer_walls(half_x, half_y) + obstacles)
    return Arena(name, shapes, (-half_x, half_x, -half_y, half_y), start)


def outer_walls(half_x: float, half_y: float) -> list[Shape]:
    """Return the walls around a rectangular room of twice these lengths [m]."""
    return [
        Shape("box", half_x + WALL, 0.0, 0.0, WALL, half_y + 2 * WALL),
        Shape("box", -half_x - WALL, 0.0, 0.0, WALL, half_y + 2 * WALL),
        Shape("box", 0.0, half_y + WALL, 0.0, half_x + 2 * WALL, WALL),
        Shape("box", 0.0, -half_y - WALL, 0.0, half_x + 2 * WALL, WALL),
    ]


def _cylinders(rng: np.random.Generator, half_x: float, half_y: float) -> list[Shape]:
    x, y, radius = rng.uniform((-half_x, -half_y, 0.05), (half_x, half_y, 0.25))
    return [Shape("cylinder", x, y, 0.0, radius, radius)]


def _boxes(rng: np.random.Generator, half_x: float, half_y: float) -> list[Shape]:
    x, y, yaw, a, b = rng.uniform((-half_x, -half_y, 0.0, 0.08, 0.08), (half_x, half_y, math.pi, 0.35, 0.35))
    return [Shape("box", x, y, yaw, a, b)]


def _walls(rng: np.random.Generator, half_x: float, half_y: float) -> list[Shape]:
    x, y, length = rng.uniform((-half_x, -half_y, 0.3), (half_x, half_y, 0.9))
    return [Shape("box", x, y, float(rng.integers(4)) * math.pi / 4, length, 0.03)]


def _corridor(rng: np.random.Generator, half_x: float, half_y: float) -> list[Shape]:
    """Two parallel walls."""
    x, y, length, width = rng.uniform((-half_x, -half_y, 0.5, 0.55), (half_x, half_y, 1.0, 0.85))
    yaw = float(rng.integers(2)) * math.pi / 2
    return [_beside((x, y, yaw), 0.0, side * width / 2, length, 0.03) for side in (-1, 1)]


def _dead_end(rng: np.random.Generator, half_x: float, half_y: float) -> list[Shape]:
    """Two parallel walls, closed at one end."""
    x, y, length, width = rng.uniform((-half_x, -half_y, 0.35, 0.6), (half_x, half_y, 0.6, 1.0))
    yaw = float(rng.integers(4)) * math.pi / 2
    walls = [_beside((x, y, yaw), 0.0, side * width / 2, length, 0.03) for side in (-1, 1)]
    return [*walls, _beside((x, y, yaw), length, 0.0, 0.03, width / 2 + 0.03)]


def _beside(pose: tuple[float, float, float], ahead: float, left: float, size_x: float, size_y: float) -> Shape:
    """Return a box at an offset in the frame at a pose (x, y, yaw)."""
    x, y, yaw = pose
    c, s = math.cos(yaw), math.sin(yaw)
    return Shape("box", x + c * ahead - s * left, y + s * ahead + c * left, yaw, size_x, size_y)


def _stays_connected(before: NDArray[np.bool_], free: NDArray[np.bool_]) -> bool:
    """Return whether the free places are connected, given those of a connected set that were free before."""
    lost = before & ~free
    rows, columns = np.flatnonzero(lost.any(axis=1)), np.flatnonzero(lost.any(axis=0))
    if not len(rows):
        return True
    # Where the places just around the lost ones are connected, every way through those has a way around them: most
    # obstacles are small, and all of the floor need not be checked.
    around = tuple(slice(max(0, lines[0] - 1), lines[-1] + 2) for lines in (rows, columns))
    return bool(scipy.ndimage.label(free[around], _NEXT)[1] == 1 or scipy.ndimage.label(free, _NEXT)[1] == 1)


def _axes(extent: tuple[float, float, float, float]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the grid's x as a row, shape (1, columns), and its y as a column, shape (rows, 1)."""
    x_min, x_max, y_min, y_max = extent
    x = np.arange(x_min + RESOLUTION / 2, x_max, RESOLUTION, dtype=np.float64)
    y = np.arange(y_min + RESOLUTION / 2, y_max, RESOLUTION, dtype=np.float64)
    return x[None, :], y[:, None]


def _points(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the grid's points, shape (rows, columns, 2)."""
    return np.stack(np.broadcast_arrays(x, y), axis=-1)


def _nearest(extent: tuple[float, float, float, float], point: tuple[float, float]) -> tuple[int, int]:
    x_min, _, y_min, _ = extent
    return int((point[1] - y_min) / RESOLUTION), int((point[0] - x_min) / RESOLUTION)


def _clearance(shapes: Iterable[Shape], x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the distance to the nearest shape, in the shape that x and y have together."""
    distance = np.full(np.broadcast_shapes(x.shape, y.shape), np.inf)
    for shape in shapes:
        np.minimum(distance, _distance(shape, x, y), out=distance)
    return distance


def _closer(
    clearance: NDArray[np.float64], shapes: Iterable[Shape], x: NDArray[np.float64], y: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return what the clearance on a grid becomes with further shapes; the one given stays as it is.

    A shape changes nothing that is farther from it than the largest clearance: the rest of the grid is left out.
    """
    closer, largest = clearance.copy(), float(clearance.max()) + RESOLUTION
    for shape in shapes:
        reach = math.hypot(shape.size_x, shape.size_y) + largest
        rows, columns = _within(y[:, 0], shape.y, reach), _within(x[0], shape.x, reach)
        part = closer[rows, columns]
        np.minimum(part, _distance(shape, x[:, columns], y[rows]), out=part)
    return closer


def _within(places: NDArray[np.float64], centre: float, reach: float) -> slice:
    """Return which of the places, ascending by `RESOLUTION`, are no farther from the centre, and perhaps a few more."""
    first, last = ((centre + side * reach - float(places[0])) / RESOLUTION for side in (-1, 1))
    return slice(max(0, math.floor(first)), max(0, math.ceil(last) + 1))


def _distance(shape: Shape, x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    # Runs for every shape of every new episode. Of a grid, x is a row and y a column: what depends on one of them is
    # computed for that alone.
    dx, dy = x - shape.x, y - shape.y
    if shape.kind == "cylinder":
        return np.hypot(dx, dy) - shape.size_x
    if shape.yaw == 0.0:  # outer walls, on the whole grid: a row and a column say it all
        ax, ay = np.abs(dx) - shape.size_x, np.abs(dy) - shape.size_y
    else:
        c, s = math.cos(shape.yaw), math.sin(shape.yaw)
        ax = np.abs(c * dx + s * dy) - shape.size_x
        ay = np.abs(c * dy - s * dx) - shape.size_y
    outside = np.asarray(np.maximum(ax, ay))
    beside_x, beside_y = ax > 0, ay > 0
    if not (beside_x.any() and beside_y.any()):
        return outside
    # At a corner; elsewhere one of the two is 0, and what is left is the other.
    return np.hypot(ax, ay, out=outside, where=beside_x & beside_y)


_OWN: dict[str, Callable[[int, float], Arena]] = {
    "turtlebot3_world": lambda _seed, _radius: turtlebot3_world(),
    "random": random_arena,
    "empty": lambda _seed, _radius: _empty(),
}
ARENAS = Registry("arena", _OWN)
"""What makes an arena of a seed and the radius of a robot [m], by name."""
