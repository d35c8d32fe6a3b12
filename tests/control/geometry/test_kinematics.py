import dataclasses
import math
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from bhd_lerobot.bodies.body import ArmChain, Placement
from bhd_lerobot.bodies.ur import MODELS, ur, ur5
from bhd_lerobot.control.commands import ResultCode
from bhd_lerobot.control.geometry.forward_kinematics import ForwardKinematics, UrGeometry
from bhd_lerobot.control.geometry.inverse_kinematics import ClosedForm
from bhd_lerobot.control.geometry.kinematics import ArmKinematics
from bhd_lerobot.errors import ConfigError
from tests.bodies.test_ur import dh_frames
from tests.cases import each_case

ARM = ur5()
CHAIN = ARM.arm.chain
A, D = (0.0, -0.425, -0.39225, 0.0, 0.0, 0.0), (0.089159, 0.0, 0.0, 0.10915, 0.09465, 0.0823)
ALPHA = (math.pi / 2, 0.0, 0.0, math.pi / 2, -math.pi / 2, 0.0)
HOME = np.array(ARM.arm.home[:6])
KINEMATICS = ArmKinematics(CHAIN, ARM.limits)
TILTED = ArmKinematics(dataclasses.replace(CHAIN, tool=Placement((0.03, -0.02, 0.15))), ARM.limits)
OTHERS = [ArmKinematics(one.arm.chain, one.limits) for one in map(ur, MODELS) if one.name != ARM.name]
TURN = 2 * math.pi
ANGLE = st.floats(-math.pi, math.pi) | st.sampled_from([0.0, math.pi / 2, -math.pi / 2, math.pi, -math.pi, 1e-7])
POSTURE = arrays(np.float64, (6,), elements=ANGLE)
MANY = np.random.default_rng(0).uniform(-math.pi, math.pi, (3000, 6))


def apart(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Largest difference of a joint, whole turns aside, shape (...)."""
    return np.abs((a - b + math.pi) % TURN - math.pi).max(axis=-1)


def pose_error(found: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Largest distance [m] or angle [rad] between frames, shape (...)."""
    turned = np.linalg.norm(found[..., :3, :3] - wanted[..., :3, :3], axis=(-2, -1)) / math.sqrt(2)
    return np.maximum(turned, np.linalg.norm(found[..., :3, 3] - wanted[..., :3, 3], axis=-1))


def moved(pose: np.ndarray, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> np.ndarray:
    there = pose.copy()
    there[:3, 3] += x, y, z
    return there


@given(q=POSTURE)
def test_frames_are_the_product_of_the_joints(q: np.ndarray) -> None:
    np.testing.assert_allclose(KINEMATICS.frames(q), dh_frames(ARM, q), atol=1e-14)


def test_jacobian_is_the_derivative() -> None:
    step = 1e-6
    for q in MANY[:50]:
        jacobian = TILTED.jacobian(q)
        for joint in range(6):
            ahead, behind = (TILTED.tool(q + sign * step * np.eye(6)[joint]) for sign in (1, -1))
            rate = (ahead - behind) / (2 * step)
            spin = rate[:3, :3] @ TILTED.tool(q)[:3, :3].T
            np.testing.assert_allclose(jacobian[:3, joint], rate[:3, 3], atol=1e-8)
            np.testing.assert_allclose(jacobian[3:, joint], (spin[2, 1], spin[0, 2], spin[1, 0]), atol=1e-8)


@pytest.mark.law
@pytest.mark.parametrize("kinematics", [KINEMATICS, TILTED, *OTHERS])
def test_every_solution_reaches_the_pose_and_the_generating_posture_is_among_them(kinematics: ArmKinematics) -> None:
    determinant = np.abs(np.linalg.det(kinematics.jacobian(MANY)))
    np.testing.assert_allclose(kinematics.manipulability(MANY), determinant, atol=1e-14)
    poses = kinematics.tool(MANY)
    found = kinematics.solutions(poses)
    error = pose_error(kinematics.tool(found), poses[:, None])
    exists = np.isfinite(found).all(axis=2)
    np.testing.assert_array_equal(exists, np.isfinite(found).any(axis=2))
    assert error[exists].max() < 1e-9
    assert exists.any(axis=1).mean() >= 0.999
    assert np.abs(found[exists]).max() <= math.pi
    regular = kinematics.manipulability(MANY) > 1e-6
    assert np.where(exists, apart(found, MANY[:, None]), np.inf).min(axis=1)[regular].max() < 1e-7


@given(q=POSTURE)
def test_solutions_at_and_near_the_borders(q: np.ndarray) -> None:
    pose = KINEMATICS.tool(q)
    found = KINEMATICS.solutions(pose, q)
    exists = np.isfinite(found).all(axis=1)
    assert exists.any()
    assert pose_error(KINEMATICS.tool(found[exists]), pose).max() < 1e-9


def test_solutions_do_not_depend_on_the_batch() -> None:
    poses = KINEMATICS.tool(MANY[:60])
    frames, found, codes = KINEMATICS.frames(MANY[:60]), KINEMATICS.solutions(poses), KINEMATICS.check(MANY[:60])
    for index, (q, pose) in enumerate(zip(MANY[:60], poses, strict=True)):
        np.testing.assert_array_equal(KINEMATICS.frames(q), frames[index])
        np.testing.assert_array_equal(KINEMATICS.solutions(pose), found[index])
        np.testing.assert_array_equal(KINEMATICS.check(q[None]), codes[index])
    np.testing.assert_array_equal(KINEMATICS.solutions(poses.reshape(3, 20, 4, 4)).reshape(60, 8, 6), found)


def test_solve_orders_by_the_largest_change_and_answers_can_be_taken() -> None:
    for q in MANY[:300]:
        result = KINEMATICS.solve(KINEMATICS.tool(q), HOME)
        if result.code != ResultCode.SUCCEEDED:
            assert result.message
            assert result.postures.shape == (0, 6)
            continue
        assert pose_error(KINEMATICS.tool(result.postures), KINEMATICS.tool(q)).max() < 1e-9
        assert (KINEMATICS.check(result.postures) == ResultCode.SUCCEEDED).all()
        change = np.abs(result.postures - HOME).max(axis=1)
        assert (np.diff(change) >= 0).all()
        assert change.max() <= math.pi + 1e-9  # no longer way round while the limits are far
        raw = KINEMATICS.solutions(KINEMATICS.tool(q), HOME)
        raw = raw[np.isfinite(raw).all(axis=1)]
        assert len(result.postures) == (KINEMATICS.check(raw) == ResultCode.SUCCEEDED).sum()


def test_solve_from_a_posture_returns_it_first() -> None:
    admissible = MANY[KINEMATICS.check(MANY) == ResultCode.SUCCEEDED][:100]
    wrist_free = np.array([0.4, -1.2, 1.5, -0.3, 0.0, 0.7])  # its last joint may be anywhere, and stays where it is
    assert np.nanmin(apart(KINEMATICS.solutions(KINEMATICS.tool(wrist_free), wrist_free), wrist_free)) < 1e-7
    for q in (HOME, *admissible, *(admissible[:20] + TURN * np.sign(-admissible[:20]))):
        first = KINEMATICS.solve(KINEMATICS.tool(q), q).postures[0]
        np.testing.assert_allclose(first, q, atol=1e-9)


def test_turns_stay_within_the_limits() -> None:
    """At a limit the joint takes the other way round, and an exact limit may be taken."""
    q = HOME + np.array([0, 0, 0, 0, 0, TURN - 0.1])
    beyond = KINEMATICS.tool(q + np.array([0, 0, 0, 0, 0, 0.3]))
    first = KINEMATICS.solve(beyond, q).postures
    assert (np.abs(first) <= TURN).all()
    np.testing.assert_allclose(first[np.abs(first[:, :5] - HOME[:5]).max(axis=1) < 1e-9, 5], q[5] + 0.3 - TURN)
    at_limit = HOME + np.array([0, 0, 0, 0, 0, TURN])
    np.testing.assert_allclose(KINEMATICS.solve(KINEMATICS.tool(at_limit), at_limit).postures[0], at_limit, atol=1e-9)


def limited(half: float) -> ArmKinematics:
    """The arm with joints that turn by no more than `half` from home."""
    lower, upper = ((*(HOME + sign * half).tolist(), bound) for sign, bound in ((-1, 0.0), (1, 0.085)))
    return ArmKinematics(CHAIN, dataclasses.replace(ARM.limits, lower=lower, upper=upper))


TOOL = KINEMATICS.tool(HOME)
FOLDED = np.array([0.0, -1.5, 2.9, 0.5, 1.5, 0.0])
STRAIGHT = np.array([0.3, -1.2, 1e-4, -0.4, 1.0, 0.0])


@each_case(
    ("kinematics", "pose", "code", "words"),
    [
        (KINEMATICS, moved(TOOL, x=0.7), ResultCode.UNREACHABLE, "short of the pose.*towards"),
        (KINEMATICS, moved(TOOL, x=-TOOL[0, 3], y=-TOOL[1, 3]), ResultCode.UNREACHABLE, "0.109 m is the least"),
        (limited(0.5), KINEMATICS.tool(HOME + 0.6), ResultCode.JOINT_LIMIT, "its limits are"),
        (KINEMATICS, KINEMATICS.tool(FOLDED), ResultCode.SELF_COLLISION, "and .* would come within"),
        (KINEMATICS, moved(TOOL, z=-0.4), ResultCode.TABLE_COLLISION, "of the table"),
        (KINEMATICS, KINEMATICS.tool(STRAIGHT), ResultCode.SINGULAR, "manipulability is"),
        (KINEMATICS, moved(TOOL, z=math.nan), ResultCode.NON_FINITE, "nan"),
        (KINEMATICS, TOOL * 1.01, ResultCode.NOT_NORMALISED, "Normalise"),
        (KINEMATICS, TOOL @ np.diag([1.0, 1.0, -1.0, 1.0]), ResultCode.NOT_NORMALISED, "Normalise"),
    ],
)
def test_every_failure_has_its_code(kinematics: ArmKinematics, pose: np.ndarray, code: ResultCode, words: str) -> None:
    result = kinematics.solve(pose, HOME)
    assert result.code == code, result.message
    assert result.postures.shape == (0, 6)
    assert re.search(words, result.message), result.message
    along = kinematics.line(np.stack([TOOL, pose]), HOME)
    assert along.code != ResultCode.SUCCEEDED
    assert along.index == 1
    assert along.message


@pytest.mark.parametrize("side", [-0.2, 0.2])
def test_a_line_is_followed_continuously(side: float) -> None:
    """Home has its first joint at pi, where the closed form's angles begin again: one of the sides crosses it."""
    poses = np.stack([moved(TOOL, x=0.1 * s, y=side * s, z=0.1 * s) for s in np.linspace(0, 1, 40)])
    result = KINEMATICS.line(poses, HOME)
    assert (result.code, result.index, result.message) == (ResultCode.SUCCEEDED, None, "")
    np.testing.assert_allclose(result.postures[0], HOME, atol=1e-9)
    assert pose_error(KINEMATICS.tool(result.postures), poses).max() < 1e-9
    assert np.abs(np.diff(result.postures, axis=0)).max() < 0.1


def test_a_line_starts_where_the_arm_is_and_stops_at_a_limit_and_before_a_singularity() -> None:
    result = KINEMATICS.line(TOOL[None], HOME + 0.1)
    assert (result.code, result.index) == (ResultCode.UNREACHABLE, 0)
    codes = []
    for side in (-0.2, 0.2):  # both can be taken with the last joint in the middle of its range
        poses = np.stack([moved(TOOL, y=side * s) for s in np.linspace(0, 1, 40)])
        codes.append(KINEMATICS.line(poses, HOME + np.array([0, 0, 0, 0, 0, TURN])).code)
    assert sorted(codes) == [ResultCode.SUCCEEDED, ResultCode.JOINT_LIMIT]
    start = np.array([math.pi, -2.0, 1.5, -1.0, 0.8, 0.0])
    turn = np.linspace(0, -1.6, 80)
    poses = KINEMATICS.tool(start + turn[:, None] * np.eye(6)[4])
    result = KINEMATICS.line(poses, start)
    assert result.code == ResultCode.SINGULAR
    assert result.index is not None
    assert 0 < result.index < 40


@each_case(
    "change",
    [
        {"a": (0.1, -0.4, -0.4, 0.0, 0.0, 0.0)},
        {"a": (0.0, 0.0, -0.4, 0.0, 0.0, 0.0)},
        {"d": (0.1, 0.1, 0.0, 0.1, 0.1, 0.1)},
        {"d": (0.1, 0.0, 0.0, 0.0, 0.1, 0.1)},
        {"alpha": (math.pi / 2, 0.0, 0.0, math.pi / 2, math.pi / 2, 0.0)},
        {"tool": Placement(rotation=((0.0, 1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, 1.0)))},
        {"base": Placement((0.0, 0.0, 0.1))},
    ],
)
def test_the_closed_form_is_for_one_geometry(change: dict) -> None:
    numbers = {"a": A, "d": D, "alpha": ALPHA, "tool": (0.0, 0.0, 0.1)}
    others = {"capsules": (), "disjoint": (), "min_distance": 0.0, "min_manipulability": 0.0}
    assert UrGeometry.of(ArmChain.from_dh(CHAIN.joints, **numbers, **others)) is not None
    assert UrGeometry.of(ArmChain.from_dh(CHAIN.joints, **numbers | change, **others)) is None


@pytest.mark.law
@pytest.mark.parametrize("turned", [(), (0, 4), (2,), (1, 2, 3, 5)])
def test_axes_that_lie_as_those_of_a_ur_have_the_closed_form(turned: tuple[int, ...]) -> None:
    """As a model of another has them: other zeros, other directions, a base and a tool that are turned."""
    rng = np.random.default_rng(7)
    own = ForwardKinematics(CHAIN)
    frames = own.frames(rng.uniform(-1, 1, 6))
    pose = own.tool(rng.uniform(-1, 1, 6))  # of the base
    flip = np.diag([1.0, -1.0, -1.0, 1.0])
    axes = [pose @ frame @ (flip if k in turned else np.eye(4)) for k, frame in enumerate(frames[:6])]
    spins = [np.block([[Rotation.from_euler("z", angle).as_matrix(), np.zeros((3, 1))], [np.eye(4)[3:]]])
             for angle in rng.uniform(-3, 3, 6)]  # fmt: skip
    axes = [axis @ spin for axis, spin in zip(axes, spins, strict=True)]
    steps = [np.linalg.inv(one) @ other for one, other in zip(axes, (*axes[1:], pose @ frames[6]), strict=True)]
    chain = dataclasses.replace(
        CHAIN,
        base=Placement.of(axes[0]),
        links=tuple(map(Placement.of, steps)),
        tool=Placement.of(own.tool(rng.uniform(-1, 1, 6))),
    )
    kinematics = ArmKinematics(chain, ARM.limits)
    assert kinematics.ur is None
    assert ClosedForm.of(kinematics) is not None
    for q in MANY[:50]:
        found = kinematics.solutions(kinematics.tool(q), q)
        exists = np.isfinite(found).all(axis=1)
        assert pose_error(kinematics.tool(found[exists]), kinematics.tool(q)).max() < 1e-8
        assert apart(found[exists], q).min() < 1e-6
        assert np.abs(found[exists]).max() <= math.pi + 1e-12
    far = kinematics.tool(HOME)
    far[:3, 3] += 5.0
    assert re.search("too far away", kinematics.solve(far, HOME).message)


@each_case(
    "change",
    [{"alpha": (0.0,) * 5}, {"tool": (0.0, math.inf, 0.0)}, {"tool": (0.0, 0.0)}],
)
def test_numbers_that_are_no_chain_are_refused(change: dict) -> None:
    others = {"capsules": (), "disjoint": (), "min_distance": 0.0, "min_manipulability": 0.0}
    with pytest.raises(ConfigError):
        ArmChain.from_dh(CHAIN.joints, **{"a": A, "d": D, "alpha": ALPHA, "tool": (0.0, 0.0, 0.1)} | change, **others)


@each_case(
    "rotation", [((1.0, 0.0, 0.0),) * 3, ((-1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), ((1.0, 0.0),) * 2]
)
def test_what_is_no_rotation_is_refused(rotation: tuple) -> None:
    with pytest.raises(ConfigError, match="rotation"):
        Placement(rotation=rotation)
