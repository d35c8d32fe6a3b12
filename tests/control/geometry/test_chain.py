"""What a tick computes of an arm: the same as the kinematics of plans, Pinocchio and numpy."""

from dataclasses import replace

import numpy as np
import pytest

from bhd_lerobot.bodies.body import HELD, Capsule, Placement
from bhd_lerobot.bodies.ur import ur5
from bhd_lerobot.control.arm.clearance import fill_geometry
from bhd_lerobot.control.arm.controller import ArmController
from bhd_lerobot.control.geometry.chain import find_distances, find_jacobian, find_torques, solve
from bhd_lerobot.control.geometry.collision import CollisionModel
from bhd_lerobot.control.geometry.dynamics import ArmDynamics
from bhd_lerobot.control.geometry.forward_kinematics import ForwardKinematics
from bhd_lerobot.control.kernels import as_objects
from bhd_lerobot.control.record import GEOMETRY as GEOMETRY_RECORD
from bhd_lerobot.control.record import new_arms
from bhd_lerobot.sim.chain import chain_from_mjcf
from tests.control.geometry.arm_models import serial

RNG = np.random.default_rng(0)
BODY = ur5(load=2.0)
CHAIN = BODY.need(type(BODY.arm)).chain
CONTROLLER = ArmController(BODY, 1, 500, 20, max_force=150.0)
[ARM], [GEOMETRY, _], [LIMITS] = map(as_objects, (CONTROLLER.arms, CONTROLLER.geometries, CONTROLLER.arm_limits))
POSTURES = RNG.uniform(-np.pi, np.pi, (100, 6))


@pytest.mark.parametrize("joints", [0, 4, 5, 6, 7])
def test_frames_jacobian_and_distances_are_those_that_plans_are_checked_with(joints: int) -> None:
    """Of the controller's arm, and of any chain: with a base and a tool that are turned, and what the gripper holds."""
    chain, arm, geometry = CHAIN, ARM, GEOMETRY
    if joints:
        chain = chain_from_mjcf(serial(joints, joints, ref=True), "tool")
        turned = Placement((0.1, -0.2, 0.3), Placement.of(ForwardKinematics(CHAIN).tool(POSTURES[0])).rotation)
        held = Capsule(HELD, joints, chain.tool.position, (0.01, 0.02, 0.3), 0.01)
        chain = replace(chain, base=turned).holding(held)
        record = np.zeros(1, GEOMETRY_RECORD)
        fill_geometry(record[0], chain)
        [arm], [geometry] = as_objects(new_arms(1)), as_objects(record)
    forward, model, dof = ForwardKinematics(chain), CollisionModel(chain), len(chain.joints)
    postures = RNG.uniform(-np.pi, np.pi, (50, dof))
    every, least = model.each(postures), np.stack(model.distances(postures))
    for k, q in enumerate(postures):
        find_jacobian(arm, geometry, q)
        np.testing.assert_allclose(arm.frames[: dof + 1], forward.frames(q)[:, :3], atol=1e-12)
        np.testing.assert_allclose(arm.jacobian[:, :dof], forward.jacobian(q), atol=1e-12)
        np.testing.assert_allclose(find_distances(arm, geometry, q, True), least[:, k], atol=1e-12)
        np.testing.assert_allclose(arm.distances[: len(every)], every[:, k], atol=1e-12)


@pytest.mark.law
@pytest.mark.parametrize("joints", [4, 6, 7])
def test_no_distance_changes_by_more_than_its_slopes(joints: int) -> None:
    """What the distance check of setpoints may leave out: nothing that could matter."""
    model = CollisionModel(CHAIN if joints == 6 else chain_from_mjcf(serial(joints, joints), "tool"))
    slopes, q = np.concatenate(model.slopes()), RNG.uniform(-np.pi, np.pi, (2000, joints))
    step = RNG.uniform(-0.3, 0.3, q.shape) * (RNG.random(q.shape) < 0.5)
    before, after = model.each(q), model.each(q + step)
    held = np.isfinite(before[:, 0])  # the others are not held against the table
    change, most = np.abs(after[held] - before[held]), (slopes @ np.abs(step).T)[held]
    assert (change <= most + 1e-9).all()
    assert (change > 0.3 * most)[most > 0].any()  # and the bounds are no empty words
    parts = np.split(before, [len(model.slopes()[0])])
    np.testing.assert_array_equal(np.stack([part.min(axis=0) for part in parts]), model.distances(q))


def test_torques_are_those_of_pinocchio() -> None:
    dynamics = ArmDynamics(BODY)
    speeds, changes = RNG.uniform(-3, 3, POSTURES.shape), RNG.uniform(-10, 10, POSTURES.shape)
    wanted = dynamics.torque(POSTURES, speeds, changes)
    for k, q in enumerate(POSTURES):
        find_torques(ARM, LIMITS, q, speeds[k], changes[k])
        np.testing.assert_allclose(ARM.needs[:6], wanted[k], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("size", [1, 3, 6])
def test_equations_are_solved(size: int) -> None:
    for _ in range(20):
        root, side = RNG.normal(size=(size, size)), RNG.normal(size=size)
        square = root @ root.T + 0.01 * np.eye(size)
        wanted = np.linalg.solve(square, side)
        solve(square, side, size)
        np.testing.assert_allclose(side, wanted, rtol=1e-6, atol=1e-8)
