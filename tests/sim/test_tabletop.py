"""The table and what lies on it: every simulation has its own, and nobody else's."""

import math
from collections.abc import Callable
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bhd_lerobot.bodies.body import Shape
from bhd_lerobot.bodies.tabletop import COLOURS, MAX_OBJECTS, TableObject, TableScene, Variation
from bhd_lerobot.bodies.turtlebot3 import turtlebot3_burger
from bhd_lerobot.bodies.turtlebot3_manipulation import turtlebot3_manipulation
from bhd_lerobot.bodies.ur import ur5
from bhd_lerobot.control.geometry.forward_kinematics import ForwardKinematics
from bhd_lerobot.control.plant import PlantReading
from bhd_lerobot.errors import SimulationError
from bhd_lerobot.sim.camera import Camera
from bhd_lerobot.sim.plant import SimulatedPlant
from bhd_lerobot.sim.tabletop import Tabletop
from bhd_lerobot.sim.world import World
from tests.cases import each_case

BODY = ur5()
HOME = np.array(BODY.arm.home)
SPOTS = ((0.55, 0.28), (0.45, -0.20), (0.75, -0.05), (0.62, 0.05), (0.38, 0.33))


def random_scene(seed: int, count: int | None = None) -> TableScene:
    rng = np.random.default_rng([7, seed])
    colours = rng.permutation(list(COLOURS))
    things = []
    for number in range(rng.integers(1, MAX_OBJECTS + 1) if count is None else count):
        cup = bool(rng.integers(2))
        a, b = rng.uniform(0.02, 0.04, 2)
        things.append(
            TableObject(
                kind="cup" if cup else "box",
                colour=str(colours[number]),
                size_x=a,
                size_y=a if cup else b,
                height=rng.uniform(0.05, 0.12),
                x=SPOTS[number][0],
                y=SPOTS[number][1],
                yaw=rng.uniform(-3, 3),
                mass=rng.uniform(0.05, 0.5),
                friction=rng.uniform(0.5, 1.1),
                shade=tuple(rng.uniform(-0.1, 0.1, 3)),
            )
        )
    posture = (*(HOME[:6] + rng.uniform(-0.1, 0.1, 6)), rng.uniform(0, 0.085))
    variation = Variation(
        light=rng.uniform(0.5, 1.5),
        light_direction=tuple(rng.uniform(-0.3, 0.3, 2)),
        camera_shift=tuple(rng.uniform(-0.05, 0.05, 3)),
        finger_friction=rng.uniform(0.5, 1.5),
        surface=tuple(rng.uniform(-0.6, 0.6, 3)),
        camera_turn=tuple(rng.uniform(-0.05, 0.05, 3)),
        wrist_turn=tuple(rng.uniform(-0.05, 0.05, 3)),
    )
    return TableScene("random", tuple(things), posture, variation=variation)


def laid(n: int, first: int = 0, count: int | None = None, threads: int | None = None) -> tuple[World, Tabletop]:
    world = World(BODY, n, threads=threads)
    table = Tabletop(world)
    table.place([random_scene(seed, count) for seed in range(first, first + n)])
    return world, table


def sweep(world: World, first: int = 0, steps: int = 40) -> None:
    """Swing each arm through its objects and table, by commands of its own."""
    generators = [np.random.default_rng([5, sim]) for sim in range(first, first + world.n)]
    for _ in range(steps):
        for row, generator in enumerate(generators):
            target = HOME.copy()
            target[:6] += generator.uniform((-0.6, 0.0, 0.0, -1, -1, -1), (0.6, 0.5, 0.5, 1, 1, 1))
            target[6] = generator.uniform(0, 0.085)
            world.ctrl[row] += 0.3 * (target - world.ctrl[row])
        world.step(10)


def everything(world: World, table: Tabletop, sim: int) -> bytes:
    snapshot = world.snapshot(np.array([sim]))
    flags = (table.arm_on_table, table.self_contact, table.arm_on_object, table.finger_on_object)
    seen = [flag[sim] for flag in flags] + [table.tool_pose[sim], table.object_poses[sim]]
    parts = [snapshot.state, *snapshot.fields.values(), *seen]
    return b"".join(np.ascontiguousarray(part).tobytes() for part in parts)


@pytest.fixture(scope="module")
def five() -> list[bytes]:
    world, table = laid(5, threads=2)
    sweep(world)
    world.check()
    return [everything(world, table, sim) for sim in range(5)]


@pytest.mark.parametrize(("n", "first", "threads"), [(1, 4, None), (3, 1, 1), (5, 0, 3)])
def test_results_do_not_depend_on_the_other_simulations_or_on_threads(
    n: int, first: int, threads: int | None, five: list[bytes]
) -> None:
    assert len(set(five)) == 5
    world, table = laid(n, first, threads=threads)
    sweep(world, first)
    assert [everything(world, table, sim) for sim in range(n)] == five[first : first + n]


def test_an_episode_does_not_depend_on_the_one_before(five: list[bytes]) -> None:
    world, table = laid(3, 20, count=5)
    sweep(world, 20, 10)
    table.place([random_scene(seed) for seed in range(3)])
    sweep(world)
    states = [world.snapshot(np.array([sim])).state.tobytes() for sim in range(3)]
    assert all(expected.startswith(state) for state, expected in zip(states, five, strict=False))


def test_each_simulation_has_objects_of_its_own() -> None:
    scenes = [random_scene(seed) for seed in range(6)]
    world, _ = laid(6)
    for sim, scene in enumerate(scenes):
        model = world.copy_model(sim)
        for number, thing in enumerate(scene.objects):
            name = f"object_{number}"
            a, b, h = thing.size_x, thing.size_y, thing.height
            kind, size = ("CYLINDER", (a, h / 2, 0)) if thing.kind == "cup" else ("BOX", (a, b, h / 2))
            geom, body = model.geom(name), model.body(name)
            assert geom.type[0] == getattr(mujoco.mjtGeom, f"mjGEOM_{kind}")
            np.testing.assert_array_equal(geom.size, size)
            np.testing.assert_allclose(geom.rgba[:3], np.clip(np.add(COLOURS[thing.colour], thing.shade), 0, 1), 1e-6)
            assert geom.friction[0] == thing.friction
            assert body.mass[0] == thing.mass
            # MuJoCo's own compiler is the oracle for the inertia.
            text = f'<geom type="{kind.lower()}" size="{size[0]} {size[1]} {size[2] or 1}" mass="{thing.mass}"/>'
            spec = f"<mujoco><compiler balanceinertia='false'/><worldbody><body><freejoint/>{text}</body></worldbody>"
            other = mujoco.MjModel.from_xml_string(spec + "</mujoco>")
            np.testing.assert_allclose(np.sort(body.inertia), np.sort(other.body_inertia[1]), rtol=1e-6)
            assert body.inertia[2] == pytest.approx(
                thing.mass * (a * a / 2 if thing.kind == "cup" else (a * a + b * b) / 3)
            )
            for pair in range(model.npair):
                if geom.id in (model.pair_geom1[pair], model.pair_geom2[pair]):
                    assert model.pair_friction[pair, 0] == thing.friction * scene.variation.finger_friction


def test_objects_stay_where_they_were_put() -> None:
    world, table = laid(4)
    start = table.object_poses
    for sim in range(4):
        things = random_scene(sim).objects
        for number, thing in enumerate(things):
            np.testing.assert_array_equal(start[sim, number, :3], (thing.x, thing.y, thing.height / 2))
            w, _, _, z = start[sim, number, 3:]
            assert 2 * math.atan2(z, w) == pytest.approx(thing.yaw, abs=1e-12)
        absent = start[sim, len(things) :]
        np.testing.assert_array_equal(absent, np.broadcast_to((0, 0, 0, 1, 0, 0, 0), absent.shape))
    world.step(1000)
    end = table.object_poses
    assert np.abs(end[..., :2] - start[..., :2]).max() < 1e-5
    assert np.abs(end[..., 2] - start[..., 2]).max() < 3e-4
    assert np.abs(end[..., 3:] - start[..., 3:]).max() < 1e-3
    assert not table.finger_on_object.any()


def test_absent_objects_touch_nothing_and_stay_absent() -> None:
    world = World(BODY, 2)
    table = Tabletop(world)
    touching = world.derived("ncon")
    for scene in (random_scene(1, 3), random_scene(1, 0)):
        table.place([scene] * 2)
        before = world.qpos[:, 8 + 7 * len(scene.objects) :].copy()
        world.step(500)
        np.testing.assert_array_equal(world.qpos[:, 8 + 7 * len(scene.objects) :], before)
    assert not np.asarray(touching).any()


def test_placing_some_leaves_the_others_alone_and_a_reset_puts_the_arm_home_and_clears_the_table() -> None:
    world, table = laid(3, count=5)
    sweep(world, steps=5)
    before = [everything(world, table, sim) for sim in range(3)]
    table.place([random_scene(40), random_scene(41)], np.array([0, 2]))
    after = [everything(world, table, sim) for sim in range(3)]
    assert [a == b for a, b in zip(after, before, strict=True)] == [False, True, False]
    world.reset([0, 2])
    np.testing.assert_array_equal(world.qpos[0, :6], HOME[:6])
    np.testing.assert_array_equal(world.qpos[2, 6:8], HOME[6] / 2)
    np.testing.assert_array_equal(world.ctrl[[0, 2]], [HOME, HOME])
    gone = table.object_poses[[0, 2]]
    world.step(500)
    np.testing.assert_array_equal(table.object_poses[[0, 2]], gone)
    np.testing.assert_array_equal(gone[..., :3], 0)
    np.testing.assert_allclose(world.qpos[[0, 2], :6], [HOME[:6]] * 2, atol=1e-5)
    assert table.object_poses[1, :, 0].all()


def test_friction_decides_whether_a_push_moves_an_object() -> None:
    """On a tilted table, which is what sideways gravity is, an object slides where its friction is too small."""
    scenes = []
    for friction in (0.3, 0.45, 0.55, 0.9):
        box = TableObject("box", "red", 0.04, 0.04, 0.04, 0.5, 0.3, friction=friction)
        scenes.append(TableScene("", (box,), BODY.arm.home))
    world = World(BODY, 4)
    table = Tabletop(world)
    table.place(scenes)
    world.model_field("opt.gravity")[:] = (0.5 * 9.81, 0, -9.81)
    world.step(250)
    assert (np.abs(table.object_poses[:, 0, 0] - 0.5) > 0.01).tolist() == [True, True, False, False]


def test_variations_reach_light_cameras_and_fingers() -> None:
    scenes = [random_scene(seed) for seed in range(3)]
    world, table = laid(3)
    nominal = world.model
    for _ in range(2):  # a second time is not on top of the first
        for sim, scene in enumerate(scenes):
            model, variation = world.copy_model(sim), scene.variation
            np.testing.assert_allclose(model.light_diffuse, nominal.light_diffuse * variation.light, rtol=1e-6)
            shift = model.camera("scene").pos - nominal.camera("scene").pos
            np.testing.assert_allclose(shift, variation.camera_shift, atol=1e-12)
            np.testing.assert_array_equal(model.camera("wrist").pos, nominal.camera("wrist").pos)
            for camera, turn in (("scene", variation.camera_turn), ("wrist", variation.wrist_turn)):
                quaternions = [one.camera(camera).quat for one in (nominal, model)]
                before, after = (Rotation.from_quat(one, scalar_first=True) for one in quaternions)
                np.testing.assert_allclose((before.inv() * after).as_rotvec(), turn, atol=1e-6)
            turned = nominal.light("main").dir + np.array([*variation.light_direction, 0])
            np.testing.assert_allclose(model.light("main").dir, turned / np.linalg.norm(turned), atol=1e-6)
            top = model.geom("table_top")
            wood = nominal.mat_rgba[top.matid[0]] + [*variation.surface, 0.0]
            np.testing.assert_allclose(top.rgba, np.clip(wood, 0, 1), atol=1e-6)
            pads = [world_model.geom("pad_left").friction[0] for world_model in (model, nominal)]
            assert pads[0] == pytest.approx(pads[1] * variation.finger_friction)
        table.place(scenes)


def test_the_target_is_drawn_where_it_is_wanted_and_touches_nothing() -> None:
    pose = (0.4, -0.2, 0.1, math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0)
    world = World(BODY, 2)
    table = Tabletop(world)
    table.place([TableScene("", (), BODY.arm.home, target_pose=each) for each in (pose, None)])
    for sim in range(2):
        model = world.copy_model(sim)
        data = mujoco.MjData(model)
        world.copy_into(sim, model, data)
        mujoco.mj_forward(model, data)
        at = np.concatenate([data.body("target").xpos, data.body("target").xquat])
        assert np.allclose(at, pose, atol=1e-12) if sim == 0 else np.abs(at).max() > 50  # out of sight
        assert not model.geom_contype[model.geom_bodyid == model.body("target").id].any()


def test_a_camera_sees_each_table_as_it_is_laid_now() -> None:
    world = World(BODY, 2)
    camera = Camera(world, 160, 120)
    table = Tabletop(world)
    try:
        empty = camera.render(0, "scene")
        full, dim = random_scene(3, 5), TableScene("", (), tuple(HOME), variation=Variation(light=0.5))
        table.place([full, dim])
        assert (camera.render(0, "scene") != empty).any(axis=2).mean() > 0.02
        assert camera.render(1, "scene").mean() < 0.7 * empty.mean()
        table.place([TableScene("", (), tuple(HOME), variation=Variation(surface=(-0.7, -0.5, 0.6)))], [1])
        red, green, blue = camera.render(1, "scene")[60:, 60:100].reshape(-1, 3).mean(axis=0)
        assert blue > 2 * max(red, green)  # the table before the arm, which is brown otherwise
        table.place([TableScene("", (), tuple(HOME))], [1])
        np.testing.assert_array_equal(camera.render(1, "scene"), empty)
        assert camera.render(0, "wrist").std() > 10
    finally:
        camera.close()


def test_a_box_s_tape_lies_along_its_length_or_across_and_nothing_but_looks_differ() -> None:
    box = TableObject("box", "blue", 0.045, 0.025, 0.08, 0.5, 0.0)
    world = World(BODY, 2)
    table = Tabletop(world)
    table.place([TableScene("", (replace(box, style=style),), BODY.arm.home) for style in ("usual", "across")])
    along, across = (world.copy_model(sim) for sim in (0, 1))
    body = along.body("object_0")
    own = [number for number in range(along.ngeom) if along.geom_bodyid[number] == body.id]
    (tape,) = [number for number in own if along.geom_size[number, 2] > 0.0401]  # higher than the box by a hair
    for model, (long, wide) in ((along, (1, 0.2)), (across, (0.2, 1))):
        np.testing.assert_allclose(model.geom_size[tape, :2], (0.045 * long, 0.025 * wide), atol=0.0004)
    same = [number for number in range(along.ngeom) if number != tape]
    for name in ("geom_size", "geom_rgba", "geom_friction"):
        np.testing.assert_array_equal(getattr(along, name)[same], getattr(across, name)[same])
    np.testing.assert_array_equal(along.body_inertia, across.body_inertia)


def touches(model: mujoco.MjModel, data: mujoco.MjData) -> tuple[bool, bool, bool, list[bool]]:
    """The flags of one simulation from its list of contacts: arm on table, on itself, on an object; gripper on each."""
    mujoco.mj_forward(model, data)
    table = own = link = False
    grip = [False] * MAX_OBJECTS
    hand = ("gripper", "finger_left_link", "finger_right_link")
    for contact in data.contact[: data.ncon]:
        names = [model.body(model.geom_bodyid[geom]).name for geom in contact.geom]
        ours = [name for name in names if name != "table" and not name.startswith("object_")]
        things = [int(name[-1]) for name in names if name.startswith("object_")]
        own |= len(ours) == 2
        table |= len(ours) == 1 and "table" in names
        if ours and things:
            if ours[0] in hand:
                grip[things[0]] = True
            else:
                link = True
    return table, own, link, grip


def test_the_flags_agree_with_the_list_of_contacts() -> None:
    world, table = laid(16, count=5)
    rng = np.random.default_rng(2)
    models = [world.copy_model(sim) for sim in range(16)]
    datas = [mujoco.MjData(model) for model in models]
    seen = []
    for _ in range(50):
        # Anywhere at all: in the table, in the objects, in itself.
        world.qpos[:, :6] = HOME[:6] + rng.uniform(-1.5, 1.5, (16, 6))
        world.qpos[:, 6:8] = rng.uniform(0, 0.0425, (16, 1))
        for number in range(MAX_OBJECTS):
            at = 8 + 7 * number
            world.qpos[:, at : at + 3] = rng.uniform((0.2, -0.3, 0.0), (0.7, 0.4, 0.5), (16, 3))
        world.forward()
        for sim in range(16):
            world.copy_into(sim, models[sim], datas[sim])
            flags = (table.arm_on_table[sim], table.self_contact[sim], table.arm_on_object[sim])
            found = (*map(bool, flags), table.finger_on_object[sim].tolist())
            assert found == touches(models[sim], datas[sim])
            seen.append((*flags, table.finger_on_object[sim].any()))
    share = np.mean(seen, axis=0)
    assert ((share > 0.005) & (share < 0.9)).all(), share  # the test has seen each flag in both states


@pytest.mark.parametrize("actuation", ["position", "torque"])
def test_the_plant_reads_six_joints_and_the_opening(actuation: str) -> None:
    world = World(ur5(actuation=actuation), 3)  # type: ignore[arg-type]
    table = Tabletop(world)
    plant = SimulatedPlant(world)
    scenes = [random_scene(seed, 0) for seed in range(3)]
    table.place(scenes)

    reading = PlantReading(3, 7)
    plant.read(reading)
    np.testing.assert_allclose(reading.position, [scene.posture for scene in scenes], atol=1e-15)
    np.testing.assert_array_equal(reading.velocity, 0)
    command = np.arange(21.0).reshape(3, 7) / 100
    plant.write(command)
    for number, name in enumerate(world.body.arm.actuators):  # type: ignore[attr-defined]
        np.testing.assert_array_equal(world.ctrl[:, world.model.actuator(name).id], command[:, number])
    world.step(5)
    plant.read(reading)
    np.testing.assert_array_equal(reading.velocity[:, 6], world.qvel[:, 6] + world.qvel[:, 7])
    assert np.abs(reading.velocity[:, 6]).min() > 0


@each_case(
    ("call", "message"),
    [
        (lambda arm: arm.base_pose, "'ur5' has no drive"),
        (lambda arm: arm.place([()]), "'ur5' has no drive"),
        (lambda arm: arm.rays("tool", np.array([[1.0, 0.0, 0.0]])), "'ur5' has no drive"),
        (lambda arm: arm.reset(poses=np.zeros((1, 3))), "'ur5' has no drive"),
        (lambda _: Tabletop(World(turtlebot3_burger())), "'turtlebot3_burger' has none"),
        (lambda _: World(turtlebot3_burger()).hold(), "'turtlebot3_burger' has none"),
        (lambda arm: Tabletop(arm).place([random_scene(0)] * 2), "2 scenes were given for 1"),
        (lambda arm: Tabletop(arm).place([TableScene("short", (), (0.0,) * 6)], [0]), "posture"),
        (lambda arm: arm.site("toool"), "Did you mean 'tool'"),
    ],
)
def test_what_does_not_fit_a_body_or_its_scene_is_refused(call: Callable[[World], object], message: str) -> None:
    with pytest.raises(SimulationError, match=message):
        call(World(BODY))


# --- an arm on a base ------------------------------------------------------------------------------------------------

MOBILE = turtlebot3_manipulation()
TOUCHES = (MOBILE.drive.touch_sensor, "touch_any", "touch_table", "touch_self")


@pytest.mark.law
def test_poses_of_an_arm_on_a_base_are_those_in_the_frame_of_the_robot() -> None:
    world = World(MOBILE, 3)
    table, home = Tabletop(world), MOBILE.arm.home
    poses = np.array([(0.0, 0.0, 0.0), (1.0, -2.0, 0.7), (-0.5, 0.3, 3.0)])
    cup = TableObject("cup", "red", 0.02, 0.02, 0.06, 0.4, 0.9, yaw=0.3)
    world.reset(None, poses)
    table.place([TableScene("one", (cup,), home)] * 3)
    np.testing.assert_allclose(world.base_pose, poses, atol=1e-12)
    for sim, (x, y, yaw) in enumerate(poses):
        base = Rotation.from_euler("z", yaw)
        expected = base.inv().apply((0.4 - x, 0.9 - y, 0.03))
        np.testing.assert_allclose(table.object_poses[sim, 0, :3], expected, atol=1e-12)
        turn = Rotation.from_quat(table.object_poses[sim, 0, 3:], scalar_first=True)
        assert (turn.inv() * base.inv() * Rotation.from_euler("z", 0.3)).magnitude() < 1e-9
    tool = ForwardKinematics(MOBILE.arm.chain).tool(np.array(home[:4]))
    np.testing.assert_allclose(table.tool_pose[:, :3], np.tile(tool[:3, 3], (3, 1)), atol=1e-9)
    world.step(250)
    np.testing.assert_allclose(table.tool_pose[:, :3], np.tile(tool[:3, 3], (3, 1)), atol=0.005)  # the servos sag
    np.testing.assert_allclose(world.base_pose, poses, atol=0.001)


@pytest.mark.parametrize(
    ("posture", "shape", "touched"),
    [
        (MOBILE.arm.home, None, ()),
        (MOBILE.arm.home, Shape("box", 0.10, 0.0, 0.0, 0.05, 0.3, 0.1), ("touch",)),
        (
            (0.0, 0.734, -0.262, -0.472, 0.02),
            Shape("box", 0.35, 0.0, 0.0, 0.1, 0.1, 0.5),
            ("touch", "touch_any", "touch_table"),
        ),
        ((0.0, 1.465, -0.942, 0.30, 0.02), None, ("touch", "touch_any", "touch_table")),
        ((0.0, 0.0, 1.38, 1.4, 0.02), None, ("touch_any", "touch_self")),
    ],
    ids=["free", "base", "scene", "floor", "itself"],
)
def test_touches_of_an_arm_on_a_base(posture: tuple[float, ...], shape: Shape | None, touched: tuple[str, ...]) -> None:
    world = World(MOBILE, 1)
    table = Tabletop(world)
    world.place([[shape] if shape else []])
    table.place([TableScene("", (), posture)])
    assert tuple(name for name in TOUCHES if world.sensor(name)[0, 0] > 0) == touched
    assert not table.arm_on_object.any()


def test_what_stands_in_the_arena_carries_an_object_until_the_gripper_touches_it() -> None:
    world = World(MOBILE, 1)
    table = Tabletop(world)
    world.place([[Shape("box", 0.4, 0.0, 0.0, 0.2, 0.2, 0.15)]])

    class Stand(TableScene):
        stand_m = 0.15

    cup = TableObject("cup", "red", 0.02, 0.02, 0.06, 0.25, 0.0, mass=0.05)
    table.place([Stand("", (cup,), MOBILE.arm.home)])
    world.step(500)
    np.testing.assert_allclose(table.object_poses[0, 0, :3], (0.25, 0.0, 0.18), atol=5e-4)
    assert not table.finger_on_object.any()
    assert not table.is_touching_more
    table.place([Stand("", (replace(cup, x=0.15, height=0.4),), MOBILE.arm.home)])
    world.qpos[0, world.joint_slice(MOBILE.arm.chain.joints)[0]] = (0.0, -0.2, 0.35, -0.1)
    world.forward()
    assert table.finger_on_object[0, 0]
    assert not table.arm_on_table[0]
    assert not table.arm_on_object[0]
