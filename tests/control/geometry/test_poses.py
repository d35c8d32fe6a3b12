"""Poses as numbers: agreement with scipy, and a sign that does not flip where tools are."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from bhd_lerobot.control.commands import Pose
from bhd_lerobot.control.geometry.poses import pose_vectors, quaternion_columns
from tests.cases import each_case

DOWN = np.array([0.0, 1.0, 0.0, 0.0])  # wxyz: half a turn about x


def matrices(rotations: Rotation, positions: np.ndarray | None = None) -> np.ndarray:
    rows = np.atleast_3d(rotations.as_matrix()).reshape(-1, 3, 3)
    result = np.tile(np.eye(4), (len(rows), 1, 1))
    result[:, :3, :3] = rows
    if positions is not None:
        result[:, :3, 3] = positions
    return result


def wxyz(rotations: Rotation) -> np.ndarray:
    return np.roll(np.atleast_2d(rotations.as_quat()), 1, axis=1)


@settings(max_examples=20)
@given(st.integers(0, 2**32 - 1))
def test_numbers_and_matrices_are_the_same_pose(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rotations = Rotation.random(50, rng=rng)
    positions = rng.normal(0, 1, (50, 3))
    vectors = pose_vectors(matrices(rotations, positions))
    assert np.array_equal(pose_vectors(matrices(rotations, positions).reshape(5, 10, 4, 4)).reshape(50, 7), vectors)
    assert np.array_equal(vectors[:, :3], positions)
    assert np.allclose(np.linalg.norm(vectors[:, 3:], axis=1), 1, atol=1e-12)
    assert (vectors[:, 3:] @ DOWN >= 0).all()
    assert np.abs((vectors[:, 3:] * wxyz(rotations)).sum(axis=1)) == pytest.approx(np.ones(50), abs=1e-12)
    for vector, matrix in zip(vectors, matrices(rotations, positions), strict=True):
        assert np.allclose(Pose(tuple(vector[:3]), tuple(vector[3:])).matrix(), matrix, atol=1e-12)


def test_no_turn_loses_precision() -> None:
    """Also turns of next to nothing and of next to half a turn, where a single formula fails."""
    axes = np.array([(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0), (0, 1, 1), (1, 1, 1), (1, -1, 0)])
    angles = np.array([0.0, 1e-9, 1e-4, 1.0, np.pi - 1e-4, np.pi - 1e-9, np.pi, 2 * np.pi - 1e-9])
    units = axes / np.linalg.norm(axes, axis=1, keepdims=True)
    rotations = Rotation.from_rotvec((angles[:, None, None] * units).reshape(-1, 3))
    for vector, expected in zip(pose_vectors(matrices(rotations)), rotations.as_matrix(), strict=True):
        back = Pose((0.0, 0.0, 0.0), tuple(vector[3:])).matrix()[:3, :3]
        assert np.allclose(back, expected, atol=1e-12)


@given(st.integers(0, 2**32 - 1))
def test_near_the_tool_that_points_down_the_numbers_do_not_jump(seed: int) -> None:
    rng = np.random.default_rng(seed)
    # Anywhere within a right angle of it: half of the quaternion's angle, so far from where the sign flips.
    ends = rng.normal(0, 1, (2, 3))
    ends *= (rng.uniform(0, np.pi / 2, 2) / np.linalg.norm(ends, axis=1))[:, None]
    path = Rotation.from_rotvec(ends[0] + np.linspace(0, 1, 500)[:, None] * (ends[1] - ends[0]))
    vectors = pose_vectors(matrices(Rotation.from_euler("x", np.pi) * path))
    assert np.abs(np.diff(vectors[:, 3:], axis=0)).max() < 0.01


def test_orientations_on_the_border_have_one_sign_only() -> None:
    for rotation in (Rotation.identity(), Rotation.from_euler("z", np.pi), Rotation.from_euler("y", np.pi)):
        for noise in (0.0, -0.0):
            vector = pose_vectors(matrices(rotation) + noise)[0]
            assert np.linalg.norm(vector[3:]) == pytest.approx(1)
    assert pose_vectors(np.eye(4)).tolist() == [0, 0, 0, 1, 0, 0, 0]


@each_case(
    ("names", "columns"),
    [
        (["x", "a_qw", "a_qx", "a_qy", "a_qz"], [1]),
        (["tool_qw.pos", "tool_qx.pos", "tool_qy.pos", "tool_qz.pos"], [0]),
        (["a_qw", "a_qx", "b_qy", "a_qz"], []),
        (["a_qx", "a_qy", "a_qz", "a_qw"], []),  # another order
        (["a_qw", "a_qx", "a_qy"], []),
        ([], []),
    ],
)
def test_quaternions_are_found_by_their_names(names: list[str], columns: list[int]) -> None:
    assert quaternion_columns(names) == columns
