"""Inverse kinematics of any chain, beside closed forms and scipy's optimisers."""

import dataclasses
import re
from functools import cache

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from bhd_lerobot.bodies.body import Arm, Limits, Placement
from bhd_lerobot.bodies.ur import MODELS, ur, ur5
from bhd_lerobot.control.commands import ResultCode
from bhd_lerobot.control.geometry.forward_kinematics import ForwardKinematics
from bhd_lerobot.control.geometry.inverse_kinematics import ClosedForm
from bhd_lerobot.control.geometry.kinematics import ArmKinematics
from bhd_lerobot.control.geometry.numeric_inverse import NumericInverse
from bhd_lerobot.sim.chain import chain_from_mjcf
from tests.control.geometry.arm_models import serial

Array = NDArray[np.float64]


def limits(lower: Array, upper: Array) -> Limits:
    ones = (1.0,) * len(lower)
    names = ("velocity", "acceleration", "stop_deceleration", "stop_jerk", "effort")
    return Limits(
        names=tuple(f"joint_{k}.pos" for k in range(len(lower))),
        lower=tuple(lower.tolist()),
        upper=tuple(upper.tolist()),
        command_timeout_s=1.0,
        **dict.fromkeys(names, ones),
    )


@cache
def arm(joints: int) -> ArmKinematics:
    """An arm of which only limits keep a posture from being taken."""
    document = serial(joints, joints, ref=True)
    chain = chain_from_mjcf(document, "tool")
    chain = dataclasses.replace(chain, capsules=(), disjoint=(), min_manipulability=0.0)
    return ArmKinematics(chain, limits(*mujoco.MjModel.from_xml_string(document).jnt_range[:joints].T))


def postures(kinematics: ArmKinematics, n: int, seed: int = 0) -> Array:
    return np.random.default_rng(seed).uniform(kinematics.lower, kinematics.upper, (n, kinematics.dof))


def off(kinematics: ForwardKinematics, q: Array, pose: Array) -> tuple[float, float]:
    """Distance [m] and angle [rad] between the tool and a pose."""
    tool = kinematics.tool(q)
    turn = Rotation.from_matrix(tool[:3, :3].T @ pose[:3, :3]).magnitude()
    return float(np.linalg.norm(tool[:3, 3] - pose[:3, 3])), float(turn)


def test_a_line_begins_at_a_posture_whatever_array_that_is_a_part_of() -> None:
    """The end of a brake is a row of a trajectory whose columns are joints."""
    kinematics = arm(6)
    (start,) = postures(kinematics, 1)
    poses = np.stack([kinematics.tool(start)] * 3)
    part = np.repeat(start, 2)[::2]
    assert not part.flags.c_contiguous
    np.testing.assert_array_equal(kinematics.line(poses, part).postures, kinematics.line(poses, start).postures)


@pytest.mark.law
@pytest.mark.parametrize("joints", [4, 5, 6, 7])
def test_the_pose_of_every_posture_is_reached_from_anywhere(joints: int) -> None:
    kinematics = arm(joints)
    for q, start in zip(postures(kinematics, 40), postures(kinematics, 40, 1), strict=True):
        pose = kinematics.tool(q)
        found = kinematics.solve(pose, start)
        assert found.code == ResultCode.SUCCEEDED, found.message
        assert len(found.turned) == len(found.postures)
        for posture, turned in zip(found.postures, found.turned, strict=True):
            distance, angle = off(kinematics, posture, pose)
            assert distance < (1e-6 if joints > 5 else 1e-4)
            assert angle == pytest.approx(turned, abs=1e-6)
            assert (kinematics.lower <= posture).all()
            assert (posture <= kinematics.upper).all()
        assert found.turned[0] < 1e-6
        if joints >= 6:
            change = np.abs(found.postures - start).max(axis=1)
            assert (np.diff(change) >= 0).all()
        near = kinematics.solve(pose, q)
        np.testing.assert_allclose(near.postures[0], q, atol=1e-6)


@pytest.mark.law
@pytest.mark.parametrize("name", MODELS)
def test_a_ur_is_solved_as_by_its_closed_form(name: str) -> None:
    body = ur(name)
    closed = ArmKinematics(body.need(Arm).chain, body.limits)
    numeric = NumericInverse(closed, closed.lower, closed.upper)
    drawn = np.random.default_rng(2).uniform(-np.pi, np.pi, (2, 100, 6))
    for q, start in zip(*drawn, strict=True):
        pose = closed.tool(q)
        found, misses = next(numeric.search(pose, start))
        assert len(found)
        assert misses.max() < 1e-6
        every = closed.solutions(pose, q)
        apart = np.abs((found[:, None] - every + np.pi) % (2 * np.pi) - np.pi).max(axis=2)
        if closed.manipulability(q) > 1e-4:
            assert np.nanmin(apart, axis=1).max() < 1e-4


def orientation_cost(kinematics: ForwardKinematics, q: Array, pose: Array) -> float:
    """As the module documents it."""
    x, y, z = np.square(kinematics.tool(q)[:3, :3] - pose[:3, :3]).sum(axis=0)
    return float(z + 0.01 * (x + y))


@pytest.mark.law
@pytest.mark.parametrize("joints", [4, 5])
def test_few_joints_reach_the_position_and_as_much_of_the_orientation_as_can_be_had(joints: int) -> None:
    kinematics = arm(joints)
    for seed, q in enumerate(postures(kinematics, 3)):
        pose = kinematics.tool(q)
        pose[:3, :3] = pose[:3, :3] @ Rotation.random(random_state=seed).as_matrix()
        found = kinematics.solve(pose, q)
        assert found.code == ResultCode.SUCCEEDED
        distance, turned = off(kinematics, found.postures[0], pose)
        assert distance < 1e-4
        assert turned == pytest.approx(found.turned[0], abs=1e-6)
        best = min(orientation_cost(kinematics, one, pose) for one in found.postures)
        bounds = list(zip(kinematics.lower, kinematics.upper, strict=True))
        for start in (q, *postures(kinematics, 2, seed)):
            place = {"type": "eq", "fun": lambda at, pose=pose: kinematics.tool(at)[:3, 3] - pose[:3, 3]}
            other = minimize(
                lambda at, pose=pose: orientation_cost(kinematics, at, pose),
                start, bounds=bounds, constraints=[place], options={"maxiter": 300, "ftol": 1e-12},
            )  # fmt: skip
            if off(kinematics, other.x, pose)[0] < 1e-6:
                assert best < other.fun + 1e-3


@pytest.mark.law
def test_seven_joints_stay_near_the_posture_that_they_are_solved_from() -> None:
    kinematics = arm(7)
    rng = np.random.default_rng(3)
    for q in postures(kinematics, 20):
        start = np.clip(q + rng.uniform(-0.2, 0.2, 7), kinematics.lower, kinematics.upper)
        pose = kinematics.tool(q)
        found = kinematics.solve(pose, start).postures
        way = min(float(np.linalg.norm(one - start)) for one in found)
        place = {"type": "eq", "fun": lambda at, pose=pose: (kinematics.tool(at) - pose)[:3].ravel()}
        bounds = list(zip(kinematics.lower, kinematics.upper, strict=True))
        other = minimize(lambda at, start=start: np.sum((at - start) ** 2), q, bounds=bounds, constraints=[place])
        assert way < np.linalg.norm(q - start) + 1e-6
        if np.abs(kinematics.tool(other.x) - pose).max() < 1e-6:
            assert way < np.sqrt(other.fun) * 1.02 + 1e-3


@pytest.mark.law
@pytest.mark.parametrize("joints", [4, 5])
def test_a_stream_that_is_a_little_off_goes_on_from_where_it_is(joints: int) -> None:
    kinematics, rng = arm(joints), np.random.default_rng(4)
    for q in postures(kinematics, 200):
        place = (q - kinematics.lower) / (kinematics.upper - kinematics.lower)
        if np.abs(place - 0.5).max() > 0.45 or np.linalg.svd(kinematics.jacobian(q)[:3], compute_uv=False)[-1] < 0.05:
            continue
        pose = kinematics.tool(q)
        pose[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec(0.02 * rng.normal(size=3)).as_matrix()
        pose[:3, 3] += 0.002 * rng.normal(size=3)
        found = kinematics.continued(pose, q)
        assert found.code == ResultCode.SUCCEEDED
        assert np.abs(found.postures[0] - q).max() < 0.3
        distance, turned = off(kinematics, found.postures[0], pose)
        assert distance < 1e-4
        assert turned == pytest.approx(found.turned[0], abs=1e-6)


@pytest.mark.parametrize("joints", [5, 7])
def test_a_line_is_followed_from_posture_to_posture(joints: int) -> None:
    kinematics = arm(joints)
    start = 0.3 * postures(kinematics, 1, 3)[0]
    poses = np.tile(kinematics.tool(start), (30, 1, 1))
    poses[:, :3, 3] += np.linspace(0, 1, 30)[:, None] * (0.05, -0.03, 0.04)
    found = kinematics.line(poses, start)
    assert (found.code, found.index) == (ResultCode.SUCCEEDED, None), found.message
    np.testing.assert_allclose(found.postures[0], start, atol=1e-6)
    assert np.abs(np.diff(found.postures, axis=0)).max() < 0.2
    distances = [off(kinematics, q, pose) for q, pose in zip(found.postures, poses, strict=True)]
    assert max(distance for distance, _ in distances) < (1e-6 if joints > 5 else 1e-4)
    if joints > 5:
        assert max(angle for _, angle in distances) < 1e-6
    elsewhere = kinematics.line(poses, start + 0.05)
    assert (elsewhere.code, elsewhere.index) == (ResultCode.UNREACHABLE, 0)
    poses[20:, :3, 3] += 5.0
    far = kinematics.line(poses, start)
    assert (far.code, far.index) == (ResultCode.UNREACHABLE, 20)


@pytest.mark.law
def test_lines_of_the_ur5_are_those_of_its_closed_form_up_to_where_they_end() -> None:
    """An axis of the one that is solved numerically is tilted by a ten millionth of a radian."""
    body = ur5()
    chain, rng, ends = body.need(Arm).chain, np.random.default_rng(4), set()
    closed = ArmKinematics(chain, body.limits)
    tilt = np.eye(4)
    tilt[0, 2], tilt[2, 0] = 1e-7, -1e-7
    second = Placement.of(chain.links[1].matrix() @ tilt)
    tilted = dataclasses.replace(chain, links=(chain.links[0], second, *chain.links[2:]))
    numeric = ArmKinematics(tilted, body.limits)
    assert ClosedForm.of(closed) is not None
    assert ClosedForm.of(numeric) is None
    home = np.array(body.need(Arm).home[:-1])
    for _ in range(25):
        start = home + rng.uniform(-0.5, 0.5, 6)
        first = closed.tool(start)
        poses = np.tile(first, (60, 1, 1))
        share = np.linspace(0, 1, 60)[:, None]
        poses[:, :3, 3] += share * rng.uniform(-0.6, 0.6, 3)
        poses[:, :3, :3] = first[:3, :3] @ Rotation.from_rotvec(share * rng.uniform(-1.5, 1.5, 3)).as_matrix()
        wanted, found = closed.line(poses, start), numeric.line(poses, start)
        # What one branch does not reach another may: the numeric one looks for it.
        jumps = (wanted.code, found.code) == (ResultCode.UNREACHABLE, ResultCode.SINGULAR)
        assert jumps or found.code == wanted.code, (found, wanted)
        assert found.index == wanted.index
        np.testing.assert_allclose(found.postures, wanted.postures, atol=1e-5)
        ends.add(wanted.code)
    assert len(ends) >= 4


@pytest.mark.parametrize("joints", [4, 6, 7])
def test_a_pose_that_cannot_be_taken_says_why(joints: int) -> None:
    kinematics = arm(joints)
    start = np.clip(np.zeros(joints), kinematics.lower, kinematics.upper)
    far = kinematics.tool(start)
    far[:3, 3] += (0.0, 0.0, 5.0)
    result = kinematics.solve(far, start)
    assert result.code == ResultCode.UNREACHABLE
    assert re.search(r"no nearer .* than \d\.?\d* m", result.message)
    narrow = ArmKinematics(kinematics.chain, limits(start - 0.2, start + 0.2))
    codes = {narrow.solve(kinematics.tool(q), start).code for q in postures(kinematics, 6)}
    assert codes == {ResultCode.JOINT_LIMIT}
    assert "its limits are" in narrow.solve(kinematics.tool(postures(kinematics, 1)[0]), start).message
    assert kinematics.solve(far * np.nan, start).code == ResultCode.NON_FINITE
