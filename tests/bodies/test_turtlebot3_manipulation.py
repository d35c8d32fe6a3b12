"""The compiled model against ROBOTIS' published figures, written down here once more, and the chain against it."""

import math
from dataclasses import replace

import mujoco
import numpy as np
import pytest

from bhd_lerobot.bodies.tabletop import TableScene
from bhd_lerobot.bodies.turtlebot3_manipulation import JOINTS, turtlebot3_manipulation
from bhd_lerobot.control.commands import ResultCode
from bhd_lerobot.control.geometry.dynamics import ArmDynamics
from bhd_lerobot.control.geometry.kinematics import ArmKinematics
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.sim.tabletop import Tabletop
from bhd_lerobot.sim.world import World

BODY = turtlebot3_manipulation()
ARM, DRIVE = BODY.arm, BODY.drive
FINGERS = ARM.gripper.joints
STRETCHED = (0.0, 1.0, -0.55, -0.45, 0.02)


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(BODY.mjcf)


@pytest.fixture(scope="module")
def kinematics() -> ArmKinematics:
    return ArmKinematics(ARM.chain, ARM.limits)


def posed(model: mujoco.MjModel, posture: np.ndarray, opening: float = 0.0) -> mujoco.MjData:
    data = mujoco.MjData(model)
    for name, value in zip((*JOINTS, *FINGERS), (*posture, *ARM.gripper.joints_at(opening)), strict=True):
        data.joint(name).qpos[0] = value
    mujoco.mj_forward(model, data)
    return data


def postures(kinematics: ArmKinematics, count: int) -> np.ndarray:
    return np.random.default_rng(0).uniform(kinematics.lower, kinematics.upper, (count, 4))


def test_masses_places_and_ranges_are_the_published_ones(model: mujoco.MjModel) -> None:
    of_arm = float(model.body("link2").subtreemass[0] + model.body("link1").mass[0])
    assert of_arm == pytest.approx(0.612, abs=0.002)
    assert model.body_subtreemass[0] == pytest.approx(1.8 + of_arm, abs=0.02)
    data = posed(model, np.zeros(4))
    left, right = (data.joint(name).xanchor for name in DRIVE.joints)
    np.testing.assert_allclose((left - right, left + right), ((0, 0.288, 0), (0, 0, 0.066)), atol=1e-12)
    anchors = [data.joint(name).xanchor for name in JOINTS]
    np.testing.assert_allclose(anchors[0], (-0.080, 0, 0.118), atol=1e-12)
    np.testing.assert_allclose(np.diff(anchors, axis=0), ((0, 0, 0.0595), (0.024, 0, 0.128), (0.124, 0, 0)), atol=1e-12)
    np.testing.assert_allclose(data.site("tool").xpos - anchors[3], (0.126, 0, 0), atol=1e-12)
    np.testing.assert_allclose(data.site("lidar").xpos, (BODY.lidar.ahead, 0, 0.132), atol=1e-12)
    assert sum(np.hypot(*np.diff(anchors, axis=0)[1:, ::2].T)) + 0.126 == pytest.approx(0.380, abs=0.001)
    for name, low, high in zip(JOINTS, ARM.limits.lower, ARM.limits.upper, strict=False):
        np.testing.assert_allclose(model.joint(name).range, (low, high), atol=1e-4)
    wheel = BODY.drive.max_wheel_speed * 0.033
    assert wheel / 0.144 == pytest.approx(1.82)
    assert wheel >= 0.26


@pytest.mark.law
def test_the_chain_is_that_of_the_model(model: mujoco.MjModel, kinematics: ArmKinematics) -> None:
    for posture in postures(kinematics, 50):
        site = posed(model, posture).site("tool")
        tool = kinematics.tool(posture)
        np.testing.assert_allclose(tool[:3, 3], site.xpos, atol=1e-12)
        np.testing.assert_allclose(tool[:3, :3], site.xmat.reshape(3, 3), atol=1e-12)


@pytest.mark.law
def test_a_posture_that_the_checks_allow_touches_neither_the_robot_nor_the_floor(
    model: mujoco.MjModel, kinematics: ArmKinematics
) -> None:
    every = postures(kinematics, 1500)
    allowed = every[kinematics.check(every) == int(ResultCode.SUCCEEDED)]
    assert len(allowed) > 500
    for opening in (0.0, ARM.gripper.max_opening):
        for posture in allowed[:400]:
            data = posed(model, posture, opening)
            assert not [[model.geom(geom).name for geom in contact.geom] for contact in data.contact]
            assert min(data.geom(name).xpos[2] for name in ("finger_left", "finger_right", "palm")) > 0.0


@pytest.mark.law
def test_the_inertias_are_those_of_the_model(model: mujoco.MjModel, kinematics: ArmKinematics) -> None:
    dynamics = ArmDynamics(BODY)
    places = [int(model.joint(name).dofadr[0]) for name in JOINTS]
    for posture in postures(kinematics, 20):
        data = posed(model, posture, ARM.home[-1])
        full = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, full)
        terms = dynamics.terms(posture[None], np.zeros((1, 4)))
        np.testing.assert_allclose(terms.mass[0], full[np.ix_(places, places)], rtol=0.03, atol=2e-4)
        np.testing.assert_allclose(terms.gravity[0], data.qfrc_bias[places], atol=0.01)


def test_home_lies_within_the_outline_of_the_base(model: mujoco.MjModel, kinematics: ArmKinematics) -> None:
    data = posed(model, np.array(ARM.home[:4]), 0.0)
    for geom in np.flatnonzero(model.geom_contype | model.geom_conaffinity).tolist():
        turn, size = data.geom_xmat[geom].reshape(3, 3), model.geom_size[geom]
        half = np.abs(turn) @ model.geom_aabb[geom, 3:]
        if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_CAPSULE:
            half = np.abs(turn[:, 2]) * size[1] + size[0]
        x, y, _ = data.geom_xpos[geom]
        assert x - half[0] >= DRIVE.outline[0][0] - 1e-6
        assert any(
            x + half[0] <= front + 1e-6 and abs(y) + half[1] <= width + 1e-6 for _, front, width in DRIVE.outline
        )
        assert math.hypot(abs(x) + half[0], abs(y) + half[1]) <= DRIVE.radius + 0.001
    assert kinematics.explain(np.array(ARM.home[:4])) == ""


@pytest.mark.law
def test_no_motion_of_the_base_tips_it_with_the_payload_at_full_reach() -> None:
    loaded = BODY.mjcf.replace(
        '<site name="tool"',
        f'<body name="held" pos="0.126 0 0"><inertial pos="0 0 0" mass="{ARM.payload}" diaginertia="1e-5 1e-5 1e-5"/>'
        '</body><site name="tool"',
    )
    world = World(replace(BODY, mjcf=loaded), 1)
    Tabletop(world).place([TableScene("stretched", (), STRETCHED)])
    world.step(BODY.physics_hz // 2)
    speeds, limits, worst = np.zeros(2), DRIVE.limits, 0.0
    for twist, bound in (
        ((0.26, 0.0), limits.acceleration),
        ((0.0, 0.0), limits.stop_deceleration),
        ((-0.26, 0.0), limits.acceleration),
        ((0.0, 0.0), limits.stop_deceleration),
        ((0.0, 1.82), limits.acceleration),
        ((0.0, 0.0), limits.stop_deceleration),
    ):
        for _ in range(BODY.physics_hz):
            most = np.array(bound) / BODY.physics_hz
            speeds += np.clip(np.array(twist) - speeds, -most, most)
            world.ctrl[0, :2] = (speeds[0] + speeds[1] * np.array((-0.144, 0.144))) / DRIVE.wheel_radius
            world.step(1)
            worst = max(worst, abs(2 * math.asin(float(world.qpos[0, 5]))))
    assert worst < math.radians(1.0)
    world.check()


@pytest.mark.parametrize("load", [-0.1, 0.2, math.nan])
def test_a_load_that_it_cannot_carry_is_refused(load: float) -> None:
    with pytest.raises(ConfigError, match=r"robot\.payload"):
        turtlebot3_manipulation(load=load)
