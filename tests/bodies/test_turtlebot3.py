"""The compiled model against ROBOTIS' published figures, written down here once more."""

import math

import mujoco
import numpy as np
import pytest

from bhd_lerobot.bodies.arenas import BURGER_RADIUS
from bhd_lerobot.bodies.turtlebot3 import turtlebot3_burger

BODY = turtlebot3_burger()


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(BODY.mjcf)


@pytest.fixture(scope="module")
def data(model: mujoco.MjModel) -> mujoco.MjData:
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return data


def surface_points(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """Points on the surface of every geom, world frame, shape (points, 3)."""
    grid = np.linspace(-1, 1, 21)
    box = np.stack(np.meshgrid(grid, grid, grid), -1).reshape(-1, 3)
    angle = np.linspace(0, 2 * np.pi, 73)
    circle = np.stack([np.cos(angle), np.sin(angle)], -1)
    sphere = np.concatenate(
        [np.column_stack([circle * math.cos(t), np.full(73, math.sin(t))]) for t in np.linspace(-1.57, 1.57, 37)]
    )
    points = []
    for geom in range(model.ngeom):
        size, kind = model.geom_size[geom], model.geom_type[geom]
        if kind == mujoco.mjtGeom.mjGEOM_BOX:
            local = box * size
        elif kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
            local = np.concatenate([np.column_stack([circle * size[0], np.full(73, z)]) for z in (-size[1], size[1])])
        elif kind == mujoco.mjtGeom.mjGEOM_SPHERE:
            local = sphere * size[0]
        else:
            assert kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID
            local = sphere * size
        points.append(data.geom_xpos[geom] + local @ data.geom_xmat[geom].reshape(3, 3).T)
    return np.concatenate(points)


def test_mass_and_dimensions_are_the_published_ones(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    assert model.body_subtreemass[0] == pytest.approx(1.0, abs=0.02)
    points = surface_points(model, data)
    np.testing.assert_allclose(np.ptp(points, axis=0), (0.138, 0.178, 0.192), atol=0.003)
    assert points[:, 2].min() == pytest.approx(0.0, abs=1e-6)
    assert points[:, 2].max() <= BODY.drive.height
    reach = np.hypot(*points[:, :2].T).max()
    assert reach <= BODY.drive.radius <= reach + 0.005
    assert BODY.drive.radius == BURGER_RADIUS


@pytest.mark.law
def test_wheels_are_where_and_as_large_as_published(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    left, right = (data.joint(name).xanchor for name in BODY.drive.joints)
    np.testing.assert_allclose(left - right, (0, 0.160, 0), atol=1e-12)
    np.testing.assert_allclose(left + right, (0, 0, 2 * 0.033), atol=1e-12)
    assert BODY.drive.wheel_separation == 0.160
    assert BODY.drive.wheel_radius == 0.033
    for name in ("tyre_left", "tyre_right"):
        lowest = data.geom(name).xpos[2] - model.geom(name).size[0]
        assert lowest == pytest.approx(0.0, abs=1e-12)
    for name in BODY.drive.joints:
        np.testing.assert_allclose(data.joint(name).xaxis, (0, 1, 0), atol=1e-12)  # forward is a positive speed


def test_velocity_limits_are_the_published_ones() -> None:
    assert BODY.limits.names == ("x.vel", "theta.vel")
    assert BODY.limits.velocity == (0.22, 2.84)
    # The wheels are fast enough for each limit alone.
    fastest = max(0.22 / 0.033, 2.84 * 0.080 / 0.033)
    assert BODY.drive.max_wheel_speed == pytest.approx(fastest)


def test_compiled_actuators_have_the_torque_limit_and_the_gain_of_the_body(model: mujoco.MjModel) -> None:
    for name, joint in zip(BODY.drive.actuators, BODY.drive.joints, strict=True):
        actuator = model.actuator(name)
        assert actuator.trnid[0] == model.joint(joint).id
        assert actuator.forcelimited[0]
        np.testing.assert_array_equal(actuator.forcerange, (-BODY.drive.max_torque, BODY.drive.max_torque))
        assert actuator.gainprm[0] == BODY.drive.servo_gain
        np.testing.assert_array_equal(actuator.biasprm[:3], (0, 0, -BODY.drive.servo_gain))
        assert actuator.gear[0] == 1


def test_a_stop_stays_within_what_the_tyres_can_carry(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Newton and Euler: the friction that each stop deceleration needs, against 0.9 of the weight."""
    mass = model.body_subtreemass[0]
    mujoco.mj_crb(model, data)
    full = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, full)
    yaw_inertia = full[5, 5]
    linear, angular = BODY.limits.stop_deceleration
    friction = 0.9 * mass * 9.81
    assert mass * linear <= friction
    assert yaw_inertia * angular / (BODY.drive.wheel_separation / 2) <= friction


def test_the_servo_is_slower_than_a_physics_step_and_fast_enough_to_stop(model: mujoco.MjModel) -> None:
    rotor = model.joint("wheel_left").armature[0] + model.body("wheel_left").inertia[1]
    time_constant = (model.body_subtreemass[0] * 0.033**2 / 2 + rotor) / BODY.drive.servo_gain
    assert 2 / BODY.physics_hz <= time_constant <= 0.02


def test_the_lidar_is_the_lds_01(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    assert BODY.lidar is not None
    assert (BODY.lidar.beams, BODY.lidar.range_min, BODY.lidar.range_max) == (360, 0.12, 3.5)
    assert (BODY.lidar.rate_hz, BODY.lidar.noise_std) == (5, 0.01)
    np.testing.assert_allclose(data.site(BODY.lidar.site).xpos, (-0.032, 0, 0.182), atol=1e-12)
    np.testing.assert_allclose(data.site(BODY.lidar.site).xmat, np.eye(3).ravel(), atol=1e-12)


def test_the_centre_of_mass_lies_between_the_three_points_that_the_robot_stands_on(data: mujoco.MjData) -> None:
    x, y, z = data.subtree_com[0]
    assert -0.081 < x < 0
    assert abs(y) < 0.08 * (1 + x / 0.081)
    assert 0.02 < z < 0.1
