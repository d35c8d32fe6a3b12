"""The compiled model against the published figures, written down here once more, and against Pinocchio."""

import dataclasses
import math

import mujoco
import numpy as np
import pytest

from bhd_lerobot.bodies.tabletop import TableScene
from bhd_lerobot.bodies.ur5 import JOINTS, ur5
from bhd_lerobot.sim.tabletop import Tabletop
from bhd_lerobot.sim.world import World

BODY = ur5()
CHAIN = BODY.arm.chain
TORQUE = (150.0, 150.0, 150.0, 28.0, 28.0, 28.0)
LAG = np.array(BODY.arm.servo_damping) / np.array(BODY.arm.servo_stiffness)  # velocity feed-forward of the servos [s]
DT = 1 / BODY.physics_hz
FINGERS = slice(6, 8)
PAYLOAD = (
    '<body name="payload" pos="0 0 0.150"><inertial pos="0 0 0" mass="1" diaginertia="1e-3 1e-3 1e-3"/></body>'
    '<site name="tool"'
)
LOADED = dataclasses.replace(BODY, mjcf=BODY.mjcf.replace('<site name="tool"', PAYLOAD))


def dh_frames(q: np.ndarray) -> list[np.ndarray]:
    """The chain's frames 0 to 6 in the base frame, each of shape (4, 4)."""
    a, d = (0, -0.425, -0.39225, 0, 0, 0), (0.089159, 0, 0, 0.10915, 0.09465, 0.0823)
    alpha = (90, 0, 0, 90, -90, 0)
    frames = [np.eye(4)]
    for i in range(6):
        c, s = math.cos(q[i]), math.sin(q[i])
        ca, sa = math.cos(math.radians(alpha[i])), math.sin(math.radians(alpha[i]))
        step = [[c, -s * ca, s * sa, a[i] * c], [s, c * ca, -c * sa, a[i] * s], [0, sa, ca, d[i]], [0, 0, 0, 1]]
        frames.append(frames[-1] @ np.array(step))
    return frames


def tool_position(q: np.ndarray) -> np.ndarray:
    flange = dh_frames(q)[6]
    return flange[:3, :3] @ (0, 0, 0.150) + flange[:3, 3]


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(BODY.mjcf)


@pytest.fixture
def data(model: mujoco.MjModel) -> mujoco.MjData:
    return mujoco.MjData(model)


def postures(count: int, seed: int = 0) -> np.ndarray:
    """Random joint angles and finger positions, shape (count, 8)."""
    rng = np.random.default_rng(seed)
    return np.hstack([rng.uniform(-2 * math.pi, 2 * math.pi, (count, 6)), rng.uniform(0, 0.0425, (count, 2))])


@pytest.mark.law
def test_the_forward_kinematics_are_the_denavit_hartenberg_chain(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    for q in postures(100):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        frames = dh_frames(q)
        np.testing.assert_allclose(data.body("gripper").xpos, frames[6][:3, 3], atol=1e-12)
        np.testing.assert_allclose(data.site("tool").xpos, tool_position(q), atol=1e-12)
        np.testing.assert_allclose(data.site("tool").xmat.reshape(3, 3), frames[6][:3, :3], atol=1e-12)
        # A joint turns about the z axis of the frame before it.
        for number, joint in enumerate(JOINTS):
            np.testing.assert_allclose(data.joint(joint).xaxis, frames[number][:3, 2], atol=1e-12)
            np.testing.assert_allclose(data.joint(joint).xanchor, frames[number][:3, 3], atol=1e-12)


def test_masses_and_centres_of_mass_are_the_published_ones(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    masses = (3.7, 8.393, 2.33, 1.219, 1.219, 0.1879)
    centres = np.array(
        [
            (0, -0.02561, 0.00193),
            (0.2125, 0, 0.11336),
            (0.15, 0, 0.0265),
            (0, -0.0018, 0.01634),
            (0, 0.0018, 0.01634),
            (0, 0, -0.001159),
        ]
    )
    for q in postures(3):
        data.qpos[:] = q
        mujoco.mj_forward(model, data)
        for number, (joint, frame) in enumerate(zip(JOINTS, dh_frames(q)[1:], strict=True)):
            body = model.joint(joint).bodyid[0]
            assert model.body_mass[body] == masses[number]
            at = frame[:3, :3] @ centres[number] + frame[:3, 3]
            np.testing.assert_allclose(data.xipos[body], at, atol=1e-9)
    assert model.body_subtreemass[model.body("gripper").id] == pytest.approx(0.9)


def test_the_collision_geometry_is_that_of_the_chains_capsules(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    q = postures(1, 5)[0]
    q[FINGERS] = 0.0425
    data.qpos[:] = q
    mujoco.mj_forward(model, data)
    frames = dh_frames(q)
    checked = []
    for capsule in CHAIN.capsules:
        frame = frames[capsule.frame]
        ends = np.array([capsule.start, capsule.end]) @ frame[:3, :3].T + frame[:3, 3]
        geom = data.geom(capsule.name)
        axis, size = geom.xmat.reshape(3, 3)[:, 2], model.geom(capsule.name).size
        if capsule.name.startswith("finger"):  # of boxes; the capsule holds them at full opening
            side = capsule.name.removeprefix("finger_")
            for name in (capsule.name, f"pad_{side}"):
                corners = np.stack(np.meshgrid(*[[-1, 1]] * 3), -1).reshape(-1, 3) * model.geom(name).size
                points = data.geom(name).xpos + corners @ data.geom(name).xmat.reshape(3, 3).T
                along = ends[1] - ends[0]
                share = np.clip((points - ends[0]) @ along / (along @ along), 0, 1)
                distance = np.linalg.norm(points - ends[0] - share[:, None] * along, axis=1)
                assert distance.max() < capsule.radius + CHAIN.min_distance
            continue
        assert size[0] == capsule.radius
        mine = np.array([geom.xpos - size[1] * axis, geom.xpos + size[1] * axis])
        assert min(np.abs(mine - ends).max(), np.abs(mine[::-1] - ends).max()) < 1e-9
        checked.append(capsule.name)
    assert len(checked) == len(CHAIN.capsules) - 2


def clear_postures(count: int, margin: float = 0.05) -> np.ndarray:
    """Random joint angles at which the arm is clear of itself and of the table, shape (count, 6)."""
    world = World(BODY)
    table = Tabletop(world)
    model = world.copy_model(0)
    data = mujoco.MjData(model)
    solid = [i for i in range(model.ngeom) if model.geom_contype[i] == 2 and model.geom_bodyid[i] > 2]
    rng, found = np.random.default_rng(11), []
    while len(found) < count:
        q = rng.uniform(-math.pi, math.pi, 6)
        table.place([TableScene("", (), (*q, 0.05))])
        world.copy_into(0, model, data)
        mujoco.mj_forward(model, data)
        if not data.ncon and data.geom_xpos[solid, 2].min() > 0.075 + margin:
            found.append(q)
    return np.array(found)


@pytest.fixture(scope="module")
def clear() -> np.ndarray:
    # At full reach a payload bends the servos most.
    stretched = np.array([0.3, -0.02, 0.0, -math.pi / 2, 0.0, 0.0])
    return np.vstack([stretched, clear_postures(13)])


def loaded_world(q: np.ndarray) -> tuple[World, Tabletop, np.ndarray]:
    """Simulations that hold 1 kg, which no gravity compensation carries, and their joints' live torques."""
    world = World(LOADED, len(q))
    table = Tabletop(world)
    table.place([TableScene("", (), (*row, 0.05)) for row in q])
    world.model_field("body_gravcomp")[:, world.model.body("payload").id] = 0.0
    return world, table, world.derived("qfrc_actuator")


def test_the_servos_hold_a_payload_within_half_a_millimetre(clear: np.ndarray) -> None:
    world, table, torque = loaded_world(clear)
    wanted = np.array([tool_position(q) for q in clear])
    largest = np.zeros(6)
    for _ in range(500):
        world.step()
        largest = np.maximum(largest, np.abs(torque[:, :6]).max(axis=0))
    sag = np.linalg.norm(table.tool_pose[:, :3] - wanted, axis=1)
    assert 0.0003 < sag.max() < 0.0005  # and the payload is felt
    assert np.abs(world.qvel[:, :6]).max() < 1e-6  # nothing rings
    assert (largest < TORQUE).all()


def test_the_servos_follow_with_velocity_feed_forward_and_within_their_torque(clear: np.ndarray) -> None:
    world, table, torque = loaded_world(clear)
    amplitude, rate = 0.12, 2 * math.pi * 0.8
    untouched = np.ones(len(clear), np.bool_)
    for k in range(1, 626):
        phase = rate * k * DT
        swing, speed = amplitude * (1 - math.cos(phase)) / 2, amplitude * rate * math.sin(phase) / 2
        world.ctrl[:, :6] = clear + swing + LAG[:6] * speed
        world.step()
        untouched &= ~(table.arm_on_table | table.self_contact)
        error = np.abs(world.qpos[untouched, :6] - clear[untouched] - swing)
        assert error.max() < 0.002
        assert (np.abs(torque[untouched, :6]) < TORQUE).all()
    assert untouched.sum() > 5


def test_a_small_step_is_answered_at_once_and_without_ringing(clear: np.ndarray) -> None:
    for joint in range(6):
        world, _, _ = loaded_world(clear[:6])
        world.step(300)
        start = world.qpos[:, joint].copy()
        world.ctrl[:, joint] += 1e-3
        world.step(40)
        assert (np.abs(world.qpos[:, joint] - start - 1e-3) < 1e-4).all()
        for _ in range(60):
            world.step()
            assert (world.qpos[:, joint] - start < 1.05e-3).all()
        assert (np.abs(world.qpos[:, joint] - start - 1e-3) < 2e-5).all()


@pytest.mark.parametrize("actuation", ["position", "torque"])
def test_the_actuators_are_those_of_the_arm(actuation: str) -> None:
    body = ur5(actuation=actuation)  # type: ignore[arg-type]
    model = World(body).model
    for number, name in enumerate(body.arm.actuators):
        actuator = model.actuator(name)
        assert actuator.id == number
        assert actuator.forcerange.tolist() == [-body.limits.effort[number], body.limits.effort[number]]
        if actuation == "position" or name == "gripper":
            stiffness, damping = body.arm.servo_stiffness[number], body.arm.servo_damping[number]
            assert actuator.gainprm[0] == stiffness
            assert actuator.biasprm[:3].tolist() == [0, -stiffness, -damping]
        else:
            assert (actuator.gainprm[0], actuator.biasprm.any()) == (1, False)
    for joint, torque in zip(JOINTS, TORQUE, strict=True):
        assert model.jnt_actfrcrange[model.joint(joint).id].tolist() == [-torque, torque]
        assert model.joint(joint).range.tolist() == [-2 * math.pi, 2 * math.pi]


def test_the_gripper_opens_and_closes_with_its_fingers_in_step(clear: np.ndarray) -> None:
    world = World(BODY, 8)
    table = Tabletop(world)
    table.place([TableScene("", (), (*q, 0.0)) for q in clear[:8]])
    for wanted in (0.085, 0.03, 0.0):
        opening = world.qpos[:, FINGERS].sum(axis=1)
        while np.abs(opening - wanted).max() > 0:
            opening += np.clip(wanted - opening, -0.15 * DT, 0.15 * DT)
            world.ctrl[:, 6] = opening
            world.step()
            assert np.abs(np.diff(world.qpos[:, FINGERS], axis=1)).max() < 2e-4
        world.step(100)
        # Commanded to a stop, the joint's limit gives way by micrometres.
        np.testing.assert_allclose(world.qpos[:, FINGERS].sum(axis=1), wanted, atol=2e-4)
    assert not table.self_contact.any()


def test_the_pads_inner_faces_are_the_opening_apart(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    for opening in (0.0, 0.03, 0.085):
        data.qpos[:] = 0
        data.qpos[FINGERS] = opening / 2
        mujoco.mj_forward(model, data)
        flange = data.body("gripper").xmat.reshape(3, 3)
        left, right = (
            (data.geom(f"pad_{side}").xpos - data.body("gripper").xpos) @ flange[:, 1] for side in ("left", "right")
        )
        half = model.geom("pad_left").size[1]
        assert left + half == pytest.approx(-opening / 2, abs=1e-12)
        assert right - half == pytest.approx(opening / 2, abs=1e-12)
