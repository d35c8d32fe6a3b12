import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from bhd_lerobot.bodies.body import ArmChain, Capsule
from bhd_lerobot.bodies.ur import ur5
from bhd_lerobot.control.geometry.collision import CollisionModel
from bhd_lerobot.control.geometry.forward_kinematics import ForwardKinematics
from bhd_lerobot.errors import ConfigError
from tests.cases import each_case

ARM = ur5()
CHAIN = ARM.arm.chain
HOME = np.array(ARM.arm.home[:6])
POINTS = arrays(np.float64, (4, 3), elements=st.integers(-8, 8).map(lambda eighths: eighths / 8))
ZERO = np.zeros(6)


def two(points: np.ndarray, radii: tuple[float, float] = (0.0, 0.0)) -> CollisionModel:
    """Two capsules that are fixed to the base."""
    ends = [tuple(map(float, point)) for point in points]
    capsules = (Capsule("a", 0, ends[0], ends[1], radii[0]), Capsule("b", 0, ends[2], ends[3], radii[1]))
    return CollisionModel(dataclasses.replace(CHAIN, capsules=capsules, disjoint=(("a", "b"),)))


def point_to_segment(points: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    way = end - start
    share = np.clip((points - start) @ way / max(way @ way, 1e-300), 0, 1)
    return np.linalg.norm(points - start - share[:, None] * way, axis=1)


@pytest.mark.law
@each_case(
    ("points", "distance"),
    [
        (((0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0)), 1.0),  # parallel, side by side
        (((0, 0, 0), (1, 0, 0), (2, 0, 0), (3, 0, 0)), 1.0),  # on one line
        (((0, 0, 0), (1, 0, 0), (3, 0, 0), (2, 0, 0)), 1.0),
        (((0, 0, 0), (1, 0, 0), (4, 4, 0), (5, 4, 0)), 5.0),  # parallel, past each other
        (((0, 0, 0), (3, 0, 0), (1, 0, 0), (2, 0, 0)), 0.0),  # one in the other
        (((-1, 0, 0), (1, 0, 0), (0, -1, 0.5), (0, 1, 0.5)), 0.5),  # crossed
        (((-1, 0, 0), (1, 0, 0), (0, 2, 0), (0, 5, 0)), 2.0),  # the end of one, the middle of the other
        (((0, 0, 0), (1, 0, 0), (4, 0, 4), (9, 0, 4)), 5.0),  # two ends
        (((0, 0, 0), (0, 0, 0), (3, 4, 0), (3, 4, 0)), 5.0),  # balls
        (((0, 0, 0), (0, 0, 0), (-1, 2, 0), (1, 2, 0)), 2.0),
        (((0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1 + 1e-9, 0)), 1.0),  # nearly parallel
    ],
)
def test_distances_of_segments_by_hand(points: tuple, distance: float) -> None:
    found, _ = two(np.array(points), (0.1, 0.25)).distances(ZERO)
    np.testing.assert_allclose(found, distance - 0.35, atol=1e-9)


@given(points=POINTS)
def test_distance_of_segments_against_samples(points: np.ndarray) -> None:
    found = float(two(points).distances(ZERO)[0])
    shares = np.linspace(0, 1, 1001)[:, None]
    sampled = point_to_segment(points[0] + shares * (points[1] - points[0]), points[2], points[3]).min()
    step = np.linalg.norm(points[1] - points[0]) / 1000
    assert sampled - step <= found + 1e-9
    assert found <= sampled + 1e-9
    for order in ((2, 3, 0, 1), (1, 0, 2, 3), (0, 1, 3, 2)):  # neither the order of the segments nor of their ends
        np.testing.assert_allclose(two(points[list(order)]).distances(ZERO)[0], found, atol=1e-9)


def test_distances_of_the_arm_against_samples() -> None:
    model, forward = CollisionModel(CHAIN), ForwardKinematics(CHAIN)
    postures = np.random.default_rng(0).uniform(-math.pi, math.pi, (200, 6))
    self_distance, table_distance = model.distances(postures)
    shares = np.linspace(0, 1, 101)[:, None]
    for posture, self_found, table_found in zip(postures, self_distance, table_distance, strict=True):
        frames = forward.frames(posture)
        ends, radii = {}, {}
        for capsule in CHAIN.capsules:
            frame = frames[capsule.frame]
            ends[capsule.name] = [frame[:3, :3] @ end + frame[:3, 3] for end in (capsule.start, capsule.end)]
            radii[capsule.name] = capsule.radius
        distances = {}
        for a, b in CHAIN.disjoint:
            points = ends[a][0] + shares * (ends[a][1] - ends[a][0])
            distances[a, b] = point_to_segment(points, *ends[b]).min() - radii[a] - radii[b]
        assert min(distances.values()) - 0.005 <= self_found <= min(distances.values()) + 1e-9
        assert distances[model.closest_pair(posture)] <= self_found + 0.005
        heights = {c.name: min(end[2] for end in ends[c.name]) - c.radius for c in CHAIN.capsules if c.frame >= 2}
        heights["upper_arm"] = ends["upper_arm"][1][2] - radii["upper_arm"]  # its other end stands still
        np.testing.assert_allclose(table_found, min(heights.values()), atol=1e-12)
        np.testing.assert_allclose(heights[model.lowest(posture)], table_found, atol=1e-12)


def test_without_capsules_nothing_is_near_and_unknown_ones_are_refused() -> None:
    nothing = CollisionModel(dataclasses.replace(CHAIN, capsules=(), disjoint=()))
    assert [float(distance) for distance in nothing.distances(HOME)] == [math.inf, math.inf]
    chain: ArmChain = dataclasses.replace(CHAIN, disjoint=(("base", "forarm"),))
    with pytest.raises(ConfigError, match=r"'forarm'.*Did you mean 'forearm'"):
        CollisionModel(chain)
