"""Ranges against plane geometry that is computed here from the shapes alone."""

import dataclasses
import math
from typing import Any

import numpy as np
import pytest

from bhd_lerobot.bodies.arenas import random_arena, turtlebot3_world
from bhd_lerobot.bodies.body import LidarSpec, Shape
from bhd_lerobot.bodies.turtlebot3 import turtlebot3_burger
from bhd_lerobot.errors import ConfigError, SimulationError
from bhd_lerobot.sim.lidar import Lidar
from bhd_lerobot.sim.world import World
from tests.cases import each_case

BODY = turtlebot3_burger(lidar_noise_std=0.0)
LIDAR_BEHIND_AXIS = 0.032  # [m]


def spec_with(**changes: float) -> LidarSpec:
    assert BODY.lidar is not None
    return dataclasses.replace(BODY.lidar, **changes)


def rngs(n: int, seed: int = 0) -> list[np.random.Generator]:
    return [np.random.default_rng([seed, sim]) for sim in range(n)]


def distance_to_circle(x: float, y: float, radius: float, origin: np.ndarray, heading: np.ndarray) -> float:
    """The smallest t >= 0 with |origin + t heading - centre| = radius."""
    to_centre = np.array([x, y]) - origin
    along = to_centre @ heading
    across = to_centre[0] * heading[1] - to_centre[1] * heading[0]
    if abs(across) > radius:
        return math.inf
    half = math.sqrt(radius**2 - across**2)
    hits = [t for t in (along - half, along + half) if t >= 0]
    return min(hits, default=math.inf)


def distance_to_segment(a: np.ndarray, b: np.ndarray, origin: np.ndarray, heading: np.ndarray) -> float:
    matrix = np.column_stack([heading, a - b])
    if abs(np.linalg.det(matrix)) < 1e-14:
        return math.inf
    t, s = np.linalg.solve(matrix, a - origin)
    return float(t) if t >= 0 and -1e-12 <= s <= 1 + 1e-12 else math.inf


def distance_to_shape(shape: Shape, origin: np.ndarray, heading: np.ndarray) -> float:
    if shape.kind == "cylinder":
        return distance_to_circle(shape.x, shape.y, shape.size_x, origin, heading)
    c, s = math.cos(shape.yaw), math.sin(shape.yaw)
    corners = [
        np.array([shape.x + c * a - s * b, shape.y + s * a + c * b])
        for a, b in (
            (shape.size_x, shape.size_y),
            (-shape.size_x, shape.size_y),
            (-shape.size_x, -shape.size_y),
            (shape.size_x, -shape.size_y),
        )
    ]
    return min(distance_to_segment(corners[k - 1], corners[k], origin, heading) for k in range(4))


def expected_scan(shapes: tuple[Shape, ...], pose: tuple[float, float, float], beams: int) -> np.ndarray:
    x, y, yaw = pose
    origin = np.array([x - LIDAR_BEHIND_AXIS * math.cos(yaw), y - LIDAR_BEHIND_AXIS * math.sin(yaw)])
    ranges = []
    for beam in range(beams):
        angle = yaw + 2 * math.pi * beam / beams
        heading = np.array([math.cos(angle), math.sin(angle)])
        ranges.append(min((distance_to_shape(shape, origin, heading) for shape in shapes), default=math.inf))
    return np.clip(ranges, 0.12, 3.5)


def scan(shapes: tuple[Shape, ...], pose: tuple[float, float, float], beams: int = 360) -> np.ndarray:
    world = World(BODY)
    world.place([shapes])
    world.reset(poses=np.array([pose]))
    lidar = Lidar(world, spec_with(), beams)
    lidar.scan(rngs(1))
    return lidar.ranges[0].copy()


@each_case(
    ("seed", "pose"),
    [(0, None), (1, None), *(("world", pose) for pose in ((0.55, 0.5, 2.0), (-0.4, -1.7, -3.0)))],
)
def test_ranges_are_the_distances_to_the_shapes(seed: Any, pose: tuple[float, float, float] | None) -> None:
    arena = turtlebot3_world() if seed == "world" else random_arena(seed)
    measured, expected = (one(arena.shapes, pose or arena.start, 360) for one in (scan, expected_scan))
    # A beam along an edge may take either side of it.
    grazing = np.abs(np.diff(expected, append=expected[0])) > 0.3
    grazing |= np.roll(grazing, 1)
    np.testing.assert_allclose(measured[~grazing], expected[~grazing], atol=1e-6)
    assert (~grazing).mean() > 0.75
    assert (np.abs(measured - expected) > 1e-6).sum() <= 2


@pytest.mark.law
def test_beam_0_points_ahead_and_beams_run_counter_clockwise() -> None:
    ahead, left, behind = (
        Shape("cylinder", x, y, 0, radius, radius) for x, y, radius in ((1, 0, 0.1), (0, 1, 0.2), (-1, 0, 0.3))
    )
    for turn in (0.0, 0.7, -2.5):
        c, s = math.cos(turn), math.sin(turn)
        shapes = tuple(
            dataclasses.replace(shape, x=c * shape.x - s * shape.y, y=s * shape.x + c * shape.y)
            for shape in (ahead, left, behind)
        )
        ranges = scan(shapes, (0, 0, turn))
        offset = LIDAR_BEHIND_AXIS
        assert ranges[0] == pytest.approx(0.9 + offset, abs=1e-6)
        assert ranges[180] == pytest.approx(0.7 - offset, abs=1e-6)
        assert ranges[90] == pytest.approx(1.0 - math.sqrt(0.2**2 - offset**2), abs=1e-6)
        assert ranges[270] == 3.5


def test_an_obstacle_that_is_too_near_reads_the_shortest_range() -> None:
    ranges = scan((Shape("box", 0.10, 0, 0, 0.04, 1.0),), (0, 0, 0))  # 0.092 m from the lidar
    assert ranges[0] == 0.12
    assert ranges[30] == 0.12  # 0.106 m
    assert ranges[60] == pytest.approx(0.092 / math.cos(math.pi / 3), abs=1e-6)


def test_the_robot_does_not_see_itself_nor_the_floor_and_moves_no_other_way_for_being_scanned() -> None:
    world = World(BODY)
    world.reset(poses=np.array([[0.3, -0.2, 1.0]]))
    lidar = Lidar(world, spec_with())
    with pytest.raises(ValueError, match="read-only"):
        lidar.ranges[0, 0] = 1.0
    speed = 0.0
    for target in (6.0, -6.0, 0.0):
        for _ in range(100):
            speed += float(np.clip(target - speed, -0.37, 0.37))  # 2.5 m/s^2 at 200 Hz: the robot pitches
            world.ctrl[0] = speed
            world.step(world.physics_hz // 200)
            before = world.snapshot().state.tobytes()
            lidar.scan(rngs(1))
            assert world.snapshot().state.tobytes() == before
            np.testing.assert_array_equal(lidar.ranges, 3.5)


@pytest.mark.parametrize("height", [0.15, 0.2])
def test_only_what_is_as_high_as_the_lidar_is_seen(height: float) -> None:
    seen = scan((Shape("box", 1.0, 0, 0, 0.1, 0.1, height),), (0, 0, 0))[0] < 3.5
    assert seen == (height > 0.182)


@each_case("beams", [1, 90])
def test_fewer_beams_are_evenly_spaced_ones_of_all(beams: int) -> None:
    arena = random_arena(3)
    some, every = scan(arena.shapes, arena.start, beams), scan(arena.shapes, arena.start)[:: 360 // beams]
    np.testing.assert_allclose(some, every, atol=1e-9)


def test_the_noise_has_the_stated_deviation_and_no_bias() -> None:
    world = World(BODY)
    world.place([turtlebot3_world().shapes])
    world.reset(poses=np.array([[-2.0, -0.5, 0.0]]))
    quiet, noisy = Lidar(world, spec_with()), Lidar(world, spec_with(noise_std=0.01))
    quiet.scan(rngs(1))
    generators = rngs(1, 7)
    errors = []
    for _ in range(200):
        noisy.scan(generators)
        errors.append(noisy.ranges[0] - quiet.ranges[0])
    middle = (quiet.ranges[0] > 0.2) & (quiet.ranges[0] < 3.4)
    assert middle.sum() > 100
    sample = np.array(errors)[:, middle]
    # Five standard errors.
    assert abs(sample.mean()) < 5 * 0.01 / math.sqrt(sample.size)
    assert abs(sample.std() / 0.01 - 1) < 5 / math.sqrt(2 * sample.size)
    correlation = np.corrcoef(sample[:, 0], sample[:, 1])[0, 1]
    assert abs(correlation) < 5 / math.sqrt(len(sample))
    np.testing.assert_array_equal(np.array(errors)[:, quiet.ranges[0] == 3.5], 0.0)
    assert (noisy.ranges >= 0.12).all()
    assert (noisy.ranges <= 3.5).all()


def test_noise_belongs_to_the_simulation_not_to_how_many_there_are() -> None:
    arenas = [random_arena(seed) for seed in range(5)]
    many = World(BODY, 5)
    many.place([arena.shapes for arena in arenas])
    many.reset(poses=np.array([arena.start for arena in arenas]))
    together = Lidar(many, spec_with(noise_std=0.01))
    generators = rngs(5)
    together.scan(generators)
    first = together.ranges.copy()
    together.scan(generators, np.array([1, 3]))
    for sim, arena in enumerate(arenas):
        one = World(BODY, 1)
        one.place([arena.shapes])
        one.reset(poses=np.array([arena.start]))
        alone = Lidar(one, spec_with(noise_std=0.01))
        generator = rngs(5)[sim : sim + 1]
        alone.scan(generator)
        assert alone.ranges[0].tobytes() == first[sim].tobytes()
        if sim in (1, 3):
            alone.scan(generator)
        assert alone.ranges[0].tobytes() == together.ranges[sim].tobytes()


HUB = BODY.mjcf.replace('<geom name="tyre_left" class="tyre"/>', '<geom class="tyre"/><site name="hub"/>')


@each_case(
    ("mjcf", "site", "beams", "message"),
    [
        (BODY.mjcf, "lidar", 7, r"divide 360. Valid: 1, 2, 3, .* 360\."),
        (BODY.mjcf, "lidarr", 360, "Did you mean 'lidar'"),
        (HUB, "hub", 360, "not fixed"),  # it moves against the base
    ],
)
def test_a_lidar_that_cannot_be_is_refused(mjcf: str, site: str, beams: int, message: str) -> None:
    world = World(dataclasses.replace(BODY, mjcf=mjcf))
    with pytest.raises((ConfigError, SimulationError), match=message):
        Lidar(world, spec_with(site=site), beams).scan(rngs(1))
