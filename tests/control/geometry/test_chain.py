"""What a tick computes of an arm: the same as the kinematics of plans, Pinocchio and numpy."""

import numpy as np
import pytest

from bhd_lerobot.bodies.ur5 import ur5
from bhd_lerobot.control.arm.controller import ArmController
from bhd_lerobot.control.geometry.chain import find_distances, find_frames, find_jacobian, find_torques, solve
from bhd_lerobot.control.geometry.collision import CollisionModel
from bhd_lerobot.control.geometry.dynamics import ArmDynamics
from bhd_lerobot.control.geometry.forward_kinematics import ForwardKinematics
from bhd_lerobot.control.kernels import as_objects

RNG = np.random.default_rng(0)
BODY = ur5(load=2.0)
CHAIN = BODY.need(type(BODY.arm)).chain
CONTROLLER = ArmController(BODY, 1, 500, 20, max_force=150.0)
[ARM], [GEOMETRY, _], [LIMITS] = map(as_objects, (CONTROLLER.arms, CONTROLLER.geometries, CONTROLLER.arm_limits))
POSTURES = RNG.uniform(-np.pi, np.pi, (100, 6))


def test_frames_and_jacobian_are_those_of_the_chain() -> None:
    forward = ForwardKinematics(CHAIN)
    for q in POSTURES:
        find_frames(ARM, GEOMETRY, q)
        np.testing.assert_allclose(ARM.frames[:7], forward.frames(q)[:, :3], atol=1e-12)
        find_jacobian(ARM, GEOMETRY, q)
        np.testing.assert_allclose(ARM.jacobian[:, :6], forward.jacobian(q), atol=1e-12)


def test_distances_are_those_that_plans_are_checked_with() -> None:
    model = CollisionModel(CHAIN)
    every, least = model.each(POSTURES), np.stack(model.distances(POSTURES))
    for k, q in enumerate(POSTURES):
        np.testing.assert_allclose(find_distances(ARM, GEOMETRY, q, True), least[:, k], atol=1e-12)
        np.testing.assert_allclose(ARM.distances[: len(every)], every[:, k], atol=1e-12)


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
