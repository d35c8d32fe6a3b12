import functools
import itertools
import math

import numpy as np
import pytest
from scipy import ndimage
from scipy.spatial import cKDTree

from bhd_lerobot.bodies.arenas import (
    ARENAS,
    BURGER_RADIUS,
    CLEARANCE,
    RESOLUTION,
    START_CLEARANCE,
    WALL,
    Arena,
    make_arena,
    random_arena,
)
from bhd_lerobot.bodies.body import Shape
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.sim.scene import POOL_SIZE
from tests.cases import each_case

SEEDS = (*range(5), 2**62 + 12345)
made = functools.cache(random_arena)
EVERY_ARENA = [("random", seed) for seed in SEEDS] + [(name, 0) for name in ARENAS if name != "random"]


def arena_of(name: str, seed: int) -> Arena:
    return made(seed) if name == "random" else make_arena(name, seed)


def boundary(shape: Shape, spacing: float = 0.002) -> np.ndarray:
    """Points on the outline of a shape, shape (points, 2)."""
    if shape.kind == "cylinder":
        count = math.ceil(2 * math.pi * shape.size_x / spacing)
        angle = np.arange(count) * 2 * math.pi / count
        return np.stack([shape.x + shape.size_x * np.cos(angle), shape.y + shape.size_x * np.sin(angle)], -1)
    corners = np.array([(1, 1), (-1, 1), (-1, -1), (1, -1)]) * (shape.size_x, shape.size_y)
    rotation = np.array([[math.cos(shape.yaw), -math.sin(shape.yaw)], [math.sin(shape.yaw), math.cos(shape.yaw)]])
    corners = corners @ rotation.T + (shape.x, shape.y)
    edges = []
    for a, b in itertools.pairwise([*corners, corners[0]]):
        t = np.linspace(0, 1, math.ceil(np.hypot(*(b - a)) / spacing) + 1)[:, None]
        edges.append(a + (b - a) * t)
    return np.concatenate(edges)


def is_inside(shape: Shape, points: np.ndarray) -> np.ndarray:
    """Whether points are in a shape, by the angle at which they see its outline: no distance is computed."""
    outline = boundary(shape, 0.02)
    seen = np.arctan2(outline[:, 1] - points[:, None, 1], outline[:, 0] - points[:, None, 0])
    turn = np.diff(np.concatenate([seen, seen[:, :1]], axis=1), axis=1)
    turn = (turn + np.pi) % (2 * np.pi) - np.pi
    return np.abs(turn.sum(axis=1)) > np.pi


def inner_corners(arena: Arena) -> np.ndarray:
    """Corners of the inside, in order."""
    if arena.name == "turtlebot3_world":
        return np.array([(2.9 * math.cos(k * math.pi / 3), 2.9 * math.sin(k * math.pi / 3)) for k in range(6)])
    x_min, x_max, y_min, y_max = arena.extent
    return np.array([(x_min, y_min), (x_max, y_min), (x_max, y_max), (x_min, y_max)])


def test_equal_seeds_give_equal_arenas_and_others_do_not() -> None:
    assert all(random_arena(seed) == made(seed) for seed in SEEDS)
    for part in ("shapes", "start"):
        assert len({getattr(made(seed), part) for seed in range(40)}) == 40
    with pytest.raises(ConfigError, match="Did you mean 'turtlebot3_world'"):
        make_arena("turtlebot_world", 0)


@each_case(("name", "seed"), EVERY_ARENA)
def test_it_is_closed_and_fits_into_the_pool_of_a_world(name: str, seed: int) -> None:
    """The middle of every outer wall, walked once around: obstacle everywhere, without a gap."""
    arena = arena_of(name, seed)
    assert len(arena.shapes) <= POOL_SIZE
    corners = inner_corners(arena)
    centre = corners.mean(axis=0)
    for a, b in itertools.pairwise([*corners, corners[0]]):
        edge = a + (b - a) * np.linspace(0, 1, 2000)[:, None]
        normal = np.array([(b - a)[1], -(b - a)[0]]) / np.hypot(*(b - a))
        assert normal @ (a - centre) > 0
        assert arena.clearance(edge + normal * 1e-4).max() < 0
        assert arena.clearance(edge + normal * WALL)[20:-20].max() < -WALL / 2


@pytest.mark.law
@each_case(("name", "seed"), EVERY_ARENA)
def test_the_start_is_free(name: str, seed: int) -> None:
    arena = arena_of(name, seed)
    x, y, yaw = arena.start
    outlines = np.concatenate([boundary(shape) for shape in arena.shapes])
    assert np.hypot(*(outlines - (x, y)).T).min() > START_CLEARANCE - 0.002
    assert not any(is_inside(shape, np.array([[x, y]]))[0] for shape in arena.shapes)
    assert -np.pi <= yaw <= np.pi


@each_case(("name", "seed"), EVERY_ARENA)
def test_all_free_space_is_connected(name: str, seed: int) -> None:
    """On another grid than the generator's, with free space as the outlines tell it."""
    arena = arena_of(name, seed)
    x_min, x_max, y_min, y_max = arena.extent
    step = 0.03
    grid = np.stack(np.meshgrid(np.arange(x_min, x_max, step), np.arange(y_min, y_max, step)), -1)
    outlines = cKDTree(np.concatenate([boundary(shape, 0.005) for shape in arena.shapes]))
    corners = inner_corners(arena)
    edges = np.roll(corners, -1, axis=0) - corners
    offset = grid[..., None, :] - corners
    inside = (edges[:, 0] * offset[..., 1] - edges[:, 1] * offset[..., 0] > 0).all(-1)
    # A little more room than the generator asks for, because its grid may see a gap that is as wide as that exactly.
    free = inside & (outlines.query(grid)[0] > BURGER_RADIUS + CLEARANCE + RESOLUTION / 2)
    labels, _ = ndimage.label(free, np.ones((3, 3)))
    points, reachable = arena.reachable
    tree = cKDTree(points[reachable])
    for label in range(1, labels.max() + 1):
        part = grid[labels == label]
        if any(is_inside(shape, part[:1])[0] for shape in arena.shapes):
            continue  # far from the outline of an obstacle, but in it
        assert tree.query(part)[0].max() <= RESOLUTION  # every free place is one that can be reached from the start


@each_case("seed", range(3))
def test_clearance_is_the_distance_to_the_outlines(seed: int) -> None:
    arena = made(seed)
    rng = np.random.default_rng(seed)
    x_min, x_max, y_min, y_max = arena.extent
    points = rng.uniform((x_min, y_min), (x_max, y_max), (300, 2))
    spacing = 0.002
    distance = np.full(len(points), np.inf)
    for shape in arena.shapes:
        from_outline = cKDTree(boundary(shape, spacing)).query(points)[0]
        distance = np.minimum(distance, np.where(is_inside(shape, points), -from_outline, from_outline))
    # Between two neighbours on an outline the distance to it is shorter than that to either, at a distance of h by
    # at most hypot(h, spacing / 2) - h.
    np.testing.assert_allclose(arena.clearance(points), distance, atol=spacing)
    assert (distance < 0).any()


@each_case(("name", "seed"), [*EVERY_ARENA[:2], *EVERY_ARENA[-2:]])
@each_case("size", [0.25, 0.4])
def test_free_cells_are_cells_of_the_grid(name: str, seed: int, size: float) -> None:
    arena = arena_of(name, seed)
    columns, rows = arena.cells(size)
    x_min, x_max, y_min, y_max = arena.extent
    assert columns * size >= x_max - x_min - 1e-6 > (columns - 1) * size - 1e-6
    assert rows * size >= y_max - y_min - 1e-6 > (rows - 1) * size - 1e-6
    free = arena.free_cells(size)
    assert (np.diff(free) > 0).all()
    assert free[0] >= 0
    assert free[-1] < columns * rows
    assert arena.cell_of(np.array(arena.start[:2]), size) in free
    # Each free cell has a place in it where the robot fits.
    for cell in free:
        x, y = x_min + cell % columns * size, y_min + cell // columns * size
        inside = np.stack(np.meshgrid(np.linspace(x, x + size, 30), np.linspace(y, y + size, 30)), -1)
        assert arena.clearance(inside).max() > BURGER_RADIUS + CLEARANCE - 0.01


def test_cells_are_numbered_row_by_row_and_those_outside_are_clipped() -> None:
    arena = make_arena("empty", 0)
    columns, rows = arena.cells(0.5)
    assert (columns, rows) == (12, 12)
    points = np.array([(-2.9, -2.9), (-2.4, -2.9), (-2.9, -2.4), (2.9, 2.9), (99.0, 99.0), (-99.0, -99.0)])
    assert arena.cell_of(points, 0.5).tolist() == [0, 1, 12, 143, 143, 0]


def test_random_arenas_differ_in_kind() -> None:
    """Posts, boxes, and walls of which corridors and dead ends are made: few of them in one arena, many in another."""
    shapes = [made(seed).shapes[4:] for seed in range(40)]
    posts = [sum(s.kind == "cylinder" for s in scene) for scene in shapes]
    thin = [sum(s.kind == "box" and min(s.size_x, s.size_y) == 0.03 for s in scene) for scene in shapes]
    boxes = [len(scene) - p - t for scene, p, t in zip(shapes, posts, thin, strict=True)]
    for counts in (posts, thin, boxes):
        assert max(counts) - min(counts) >= 3


@pytest.mark.parametrize("name", ["turtlebot3_world", "empty"])
def test_a_random_start_is_free_and_reproducible(name: str) -> None:
    starts = set()
    for seed in range(20):
        arena = make_arena(name, seed, random_start=True)
        assert arena == make_arena(name, seed, random_start=True)
        assert arena.shapes == make_arena(name, 0).shapes
        assert arena.clearance(np.array(arena.start[:2])) > START_CLEARANCE
        x, y = arena.start[:2]
        assert abs(x) < arena.extent[1]
        assert abs(y) < arena.extent[3]
        starts.add(arena.start)
    assert len(starts) == 20
