"""The URDF is the robot: Pinocchio and MuJoCo read from it the kinematics, masses and looks that are simulated."""

from xml.etree import ElementTree

import mujoco
import numpy as np
import pinocchio
import pytest

from bhd_lerobot.bodies.registry import body_of
from bhd_lerobot.bodies.ur import MODELS
from bhd_lerobot.ros2.messages.robot_views import robot_view
from bhd_lerobot.ros2.serve.description import urdf
from bhd_lerobot.sim.description import parts_of


def described(robot_type: str) -> tuple[str, mujoco.MjModel]:
    body = body_of(robot_type)
    assert body is not None
    return urdf(robot_type, robot_view(robot_type), parts_of(body)), mujoco.MjModel.from_xml_string(body.mjcf)


@pytest.mark.law
@pytest.mark.parametrize("robot_type", MODELS)
def test_an_arm_moves_and_weighs_as_the_simulated_one(robot_type: str) -> None:
    text, simulated = described(robot_type)
    read = pinocchio.buildModelFromXML(text)
    data, state = read.createData(), mujoco.MjData(simulated)
    random = np.random.default_rng(0)
    for posture in random.uniform(-np.pi, np.pi, (20, read.nv)):
        q = np.stack([np.cos(posture), np.sin(posture)], axis=1).reshape(-1)  # as Pinocchio has continuous joints
        speeds = random.uniform(-3, 3, read.nv)
        state.qpos[: read.nv], state.qvel[: read.nv] = posture, speeds
        mujoco.mj_forward(simulated, state)
        pinocchio.framesForwardKinematics(read, data, q)
        place = data.oMf[read.getFrameId("base")].actInv(data.oMf[read.getFrameId("tool")])
        np.testing.assert_allclose(place.translation, state.site("tool").xpos, atol=1e-6)
        np.testing.assert_allclose(place.rotation, state.site("tool").xmat.reshape(3, 3), atol=1e-6)
        bias = pinocchio.nonLinearEffects(read, data, q, speeds)  # gravity, and what masses and inertias do in motion
        np.testing.assert_allclose(bias, state.qfrc_bias[: read.nv], atol=1e-6)


@pytest.mark.parametrize("robot_type", ["turtlebot3", *MODELS])
def test_masses_frames_and_solids_are_all_there(robot_type: str) -> None:
    text, simulated = described(robot_type)
    view = robot_view(robot_type)
    root = ElementTree.fromstring(text)
    links = {link.get("name", "") for link in root.iterfind("link")}
    assert links == {name for frame in (*view.frames, *view.joints) for name in (frame.parent, frame.child)}
    masses = [float(mass.get("value", "nan")) for mass in root.iterfind("link/inertial/mass")]
    assert sum(masses) == pytest.approx(simulated.body_mass.sum())
    drawn = (simulated.geom_group == 1) & (simulated.geom_bodyid > 0)
    capsules = drawn & (simulated.geom_type == mujoco.mjtGeom.mjGEOM_CAPSULE)
    assert len(root.findall("link/visual")) == drawn.sum() + 2 * capsules.sum()
    moving = [joint.get("name") for joint in root.iterfind("joint") if joint.get("type") == "continuous"]
    assert moving == [joint.joint for joint in view.joints]
    assert mujoco.MjModel.from_xml_string(text).njnt == pinocchio.buildModelFromXML(text).njoints - 1 == len(moving)
