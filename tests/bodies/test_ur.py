"""The compiled model against the published figures, written down here once more, and against Pinocchio."""

import dataclasses
import math

import mujoco
import numpy as np
import pytest

from bhd_lerobot.bodies.body import Body
from bhd_lerobot.bodies.tabletop import TableScene
from bhd_lerobot.bodies.ur import JOINTS, MODELS, ur, ur5
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.sim.tabletop import Tabletop
from bhd_lerobot.sim.world import World

DT = 1 / ur5().physics_hz
FINGERS = slice(6, 8)
PAYLOAD = (
    '<body name="payload" pos="0 0 0.150"><inertial pos="0 0 0" mass="1" diaginertia="1e-3 1e-3 1e-3"/></body>'
    '<site name="tool"'
)
UR5_CENTRES = ((0, -0.02561, 0.00193), (0.2125, 0, 0.11336), (0.15, 0, 0.0265), (0, -0.0018, 0.01634),
               (0, 0.0018, 0.01634), (0, 0, -0.001159))  # fmt: skip
# Lengths a2 and a3, offsets d1, d4, d5 and d6; masses; centres of mass; torques; speeds [deg/s]; payload.
PUBLISHED = {
    "ur3e": (
        (0.24355, 0.2132, 0.15185, 0.13105, 0.08535, 0.0921),
        (1.98, 3.4445, 1.437, 0.871, 0.805, 0.261),
        ((0, -0.02, 0), (0.13, 0, 0.1157), (0.05, 0, 0.0238), (0, 0, 0.01), (0, 0, 0.01), (0, 0, -0.02)),
        (56, 56, 28, 12, 12, 12),
        (180, 180, 180, 360, 360, 360),
        3,
    ),
    "ur5": (
        (0.425, 0.39225, 0.089159, 0.10915, 0.09465, 0.0823),
        (3.7, 8.393, 2.33, 1.219, 1.219, 0.1879),
        UR5_CENTRES,
        (150, 150, 150, 28, 28, 28),
        (180,) * 6,
        5,
    ),
    "ur5e": (
        (0.425, 0.3922, 0.1625, 0.1333, 0.0997, 0.0996),
        (3.761, 8.058, 2.846, 1.37, 1.3, 0.365),
        UR5_CENTRES,
        (150, 150, 150, 28, 28, 28),
        (180,) * 6,
        5,
    ),
    "ur10e": (
        (0.6127, 0.57155, 0.1807, 0.17415, 0.11985, 0.11655),
        (7.369, 13.051, 3.989, 2.1, 1.98, 0.615),
        ((0.021, 0, 0.027), (0.38, 0, 0.158), (0.24, 0, 0.068), (0, 0.007, 0.018), (0, 0.007, 0.018), (0, 0, -0.026)),
        (330, 330, 150, 56, 56, 56),
        (120, 120, 180, 180, 180, 180),
        8,
    ),
}


@pytest.fixture(scope="module", params=MODELS)
def body(request: pytest.FixtureRequest) -> Body:
    return ur(request.param)


def dh_frames(body: Body, q: np.ndarray) -> list[np.ndarray]:
    """The chain's frames 0 to 6 in the base frame, each of shape (4, 4)."""
    a2, a3, d1, d4, d5, d6 = PUBLISHED[body.name][0]
    a, d, alpha = (0, -a2, -a3, 0, 0, 0), (d1, 0, 0, d4, d5, d6), (90, 0, 0, 90, -90, 0)
    frames = [np.eye(4)]
    for i in range(6):
        c, s = math.cos(q[i]), math.sin(q[i])
        ca, sa = math.cos(math.radians(alpha[i])), math.sin(math.radians(alpha[i]))
        step = [[c, -s * ca, s * sa, a[i] * c], [s, c * ca, -c * sa, a[i] * s], [0, sa, ca, d[i]], [0, 0, 0, 1]]
        frames.append(frames[-1] @ np.array(step))
    return frames


def tool_position(body: Body, q: np.ndarray) -> np.ndarray:
    flange = dh_frames(body, q)[6]
    return flange[:3, :3] @ (0, 0, 0.150) + flange[:3, 3]


@pytest.fixture(scope="module")
def model(body: Body) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(body.mjcf)


@pytest.fixture
def data(model: mujoco.MjModel) -> mujoco.MjData:
    return mujoco.MjData(model)


def postures(count: int, seed: int = 0) -> np.ndarray:
    """Random joint angles and finger positions, shape (count, 8)."""
    rng = np.random.default_rng(seed)
    return np.hstack([rng.uniform(-2 * math.pi, 2 * math.pi, (count, 6)), rng.uniform(0, 0.0425, (count, 2))])


@pytest.mark.law
def test_the_forward_kinematics_are_the_denavit_hartenberg_chain(
    body: Body, model: mujoco.MjModel, data: mujoco.MjData
) -> None:
    for q in postures(100):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        frames = dh_frames(body, q)
        np.testing.assert_allclose(data.body("gripper").xpos, frames[6][:3, 3], atol=1e-12)
        np.testing.assert_allclose(data.site("tool").xpos, tool_position(body, q), atol=1e-12)
        np.testing.assert_allclose(data.site("tool").xmat.reshape(3, 3), frames[6][:3, :3], atol=1e-12)
        # A joint turns about the z axis of the frame before it.
        for number, joint in enumerate(JOINTS):
            np.testing.assert_allclose(data.joint(joint).xaxis, frames[number][:3, 2], atol=1e-12)
            np.testing.assert_allclose(data.joint(joint).xanchor, frames[number][:3, 3], atol=1e-12)


def test_masses_and_centres_of_mass_are_the_published_ones(
    body: Body, model: mujoco.MjModel, data: mujoco.MjData
) -> None:
    _, masses, centres, *_ = PUBLISHED[body.name]
    for q in postures(3):
        data.qpos[:] = q
        mujoco.mj_forward(model, data)
        for number, (joint, frame) in enumerate(zip(JOINTS, dh_frames(body, q)[1:], strict=True)):
            link = model.joint(joint).bodyid[0]
            assert model.body_mass[link] == masses[number]
            at = frame[:3, :3] @ centres[number] + frame[:3, 3]
            np.testing.assert_allclose(data.xipos[link], at, atol=1e-9)
    assert model.body_subtreemass[model.body("gripper").id] == pytest.approx(0.9)


def test_the_collision_geometry_is_that_of_the_chains_capsules(
    body: Body, model: mujoco.MjModel, data: mujoco.MjData
) -> None:
    chain = body.arm.chain
    q = postures(1, 5)[0]
    q[FINGERS] = 0.0425
    data.qpos[:] = q
    mujoco.mj_forward(model, data)
    frames = dh_frames(body, q)
    checked = []
    for capsule in chain.capsules:
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
                assert distance.max() < capsule.radius + chain.min_distance
            continue
        assert size[0] == capsule.radius
        mine = np.array([geom.xpos - size[1] * axis, geom.xpos + size[1] * axis])
        assert min(np.abs(mine - ends).max(), np.abs(mine[::-1] - ends).max()) < 1e-9
        checked.append(capsule.name)
    assert len(checked) == len(chain.capsules) - 2


def clear_postures(body: Body, count: int, margin: float = 0.05) -> np.ndarray:
    """Random joint angles at which the arm is clear of itself and of the table, shape (count, 6)."""
    world = World(body)
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
def clear(body: Body) -> np.ndarray:
    # At full reach a payload bends the servos most.
    stretched = np.array([0.3, -0.02, 0.0, -math.pi / 2, 0.0, 0.0])
    return np.vstack([stretched, clear_postures(body, 13)])


def loaded_world(body: Body, q: np.ndarray) -> tuple[World, Tabletop, np.ndarray]:
    """Simulations that hold 1 kg, which no gravity compensation carries, and their joints' live torques."""
    loaded = dataclasses.replace(body, mjcf=body.mjcf.replace('<site name="tool"', PAYLOAD))
    world = World(loaded, len(q))
    table = Tabletop(world)
    table.place([TableScene("", (), (*row, 0.05)) for row in q])
    world.model_field("body_gravcomp")[:, world.model.body("payload").id] = 0.0
    return world, table, world.derived("qfrc_actuator")


def test_the_servos_hold_a_payload_within_half_a_millimetre(body: Body, clear: np.ndarray) -> None:
    world, table, torque = loaded_world(body, clear)
    wanted = np.array([tool_position(body, q) for q in clear])
    largest = np.zeros(6)
    for _ in range(500):
        world.step()
        largest = np.maximum(largest, np.abs(torque[:, :6]).max(axis=0))
    sag = np.linalg.norm(table.tool_pose[:, :3] - wanted, axis=1)
    assert 0.0002 < sag.max() < 0.0005  # and the payload is felt
    assert np.abs(world.qvel[:, :6]).max() < 1e-6  # nothing rings
    assert (largest < body.limits.effort[:6]).all()


def test_the_servos_follow_with_velocity_feed_forward_and_within_their_torque(body: Body, clear: np.ndarray) -> None:
    world, table, torque = loaded_world(body, clear)
    lag = np.array(body.arm.servo_damping[:6]) / np.array(body.arm.servo_stiffness[:6])  # velocity feed-forward [s]
    amplitude, rate = 0.12, 2 * math.pi * 0.8
    untouched = np.ones(len(clear), np.bool_)
    for k in range(1, 626):
        phase = rate * k * DT
        swing, speed = amplitude * (1 - math.cos(phase)) / 2, amplitude * rate * math.sin(phase) / 2
        world.ctrl[:, :6] = clear + swing + lag * speed
        world.step()
        untouched &= ~(table.arm_on_table | table.self_contact)
        error = np.abs(world.qpos[untouched, :6] - clear[untouched] - swing)
        assert error.max() < 0.002
        assert (np.abs(torque[untouched, :6]) < body.limits.effort[:6]).all()
    assert untouched.sum() > 5


def test_a_small_step_is_answered_at_once_and_without_ringing(body: Body, clear: np.ndarray) -> None:
    for joint in range(6):
        world, _, _ = loaded_world(body, clear[:6])
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
@pytest.mark.parametrize("name", MODELS)
def test_the_actuators_are_those_of_the_arm(name: str, actuation: str) -> None:
    body = ur(name, actuation=actuation)  # type: ignore[arg-type]
    *_, torques, speeds, payload = PUBLISHED[name]
    assert body.limits.velocity[:6] == pytest.approx(np.radians(speeds), abs=0)
    assert (body.limits.effort[:6], body.arm.payload) == (torques, payload)
    model = World(body).model
    for number, own in enumerate(body.arm.actuators):
        actuator = model.actuator(own)
        assert actuator.id == number
        assert actuator.forcerange.tolist() == [-body.limits.effort[number], body.limits.effort[number]]
        if actuation == "position" or own == "gripper":
            stiffness, damping = body.arm.servo_stiffness[number], body.arm.servo_damping[number]
            assert actuator.gainprm[0] == stiffness
            assert actuator.biasprm[:3].tolist() == [0, -stiffness, -damping]
        else:
            assert (actuator.gainprm[0], actuator.biasprm.any()) == (1, False)
    for joint, torque in zip(JOINTS, torques, strict=True):
        assert model.jnt_actfrcrange[model.joint(joint).id].tolist() == [-torque, torque]
        assert model.joint(joint).range.tolist() == [-2 * math.pi, 2 * math.pi]


def test_the_gripper_opens_and_closes_with_its_fingers_in_step(body: Body, clear: np.ndarray) -> None:
    world = World(body, 8)
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


def test_an_arm_that_is_not_there_is_refused_with_those_that_are() -> None:
    with pytest.raises(ConfigError, match=r"Unknown arm 'ur5a'.*Valid: ur10e, ur3e, ur5, ur5e"):
        ur("ur5a")
