"""Arms from files: what is read agrees with MuJoCo, whatever the file is like, and what is missing is asked for."""

import functools
import os
import re
from dataclasses import replace
from importlib import resources
from pathlib import Path

import mujoco
import numpy as np
import pytest

from bhd_lerobot.bodies.arm_file import ArmFile, GripperFile
from bhd_lerobot.bodies.body import Arm, Body, Capsule, GripperSpec
from bhd_lerobot.bodies.so101 import SO101
from bhd_lerobot.bodies.tabletop import TableScene
from bhd_lerobot.control.commands import ResultCode
from bhd_lerobot.control.geometry.collision import CollisionModel
from bhd_lerobot.control.geometry.dynamics import ArmDynamics
from bhd_lerobot.control.geometry.forward_kinematics import ForwardKinematics
from bhd_lerobot.control.geometry.kinematics import ArmKinematics
from bhd_lerobot.control.plant import PlantReading
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.sim.files.arm import arm_body
from bhd_lerobot.sim.files.model import joint_speeds, load_model
from bhd_lerobot.sim.plant import SimulatedPlant
from bhd_lerobot.sim.tabletop import Tabletop
from bhd_lerobot.sim.world import World
from tests.cases import each_case

TEXT = resources.files("bhd_lerobot.bodies").joinpath("so101.xml").read_text(encoding="utf-8")
ARM_ONLY = re.sub(r'<body name="jaw".*?</body>', "", TEXT, flags=re.DOTALL).replace(
    '<position name="gripper" joint="gripper"/>', ""
)
BARE = re.sub(r"<actuator>.*</actuator>", "", ARM_ONLY, flags=re.DOTALL)
MOTORS = re.sub(r"<position name=", '<motor ctrlrange="-2.94 2.94" name=', ARM_ONLY).replace(
    '<position kp="17.8" forcerange="-2.94 2.94"/>', ""
)
LOOP = '<equality><connect body1="wrist" body2="base" anchor="0 0 0"/></equality>'
CAPSULE = 'type="capsule" fromto="0 0 0.022 0.026 0 0.100" size="0.021"'


def written(folder: Path, text: str, name: str = "arm.xml", **options: object) -> ArmFile:
    """Return a file with a text."""
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return ArmFile("arm", str(path), **options)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder for files of this module, with what some of them include."""
    made = tmp_path_factory.mktemp("arms")
    (made / "assets").mkdir()
    (made / "assets" / "link.obj").write_text(LINK, encoding="utf-8")
    (made / "child.xml").write_text(TEXT, encoding="utf-8")
    return made


@functools.cache
def built(folder: Path, text: str, **options: object) -> Body:
    """Return the arm of a file with a text, which takes a second."""
    return arm_body(written(folder, text, f"{len(list(folder.iterdir()))}.xml", **options))


def tool_poses(body: Body, postures: np.ndarray) -> np.ndarray:
    """Return where MuJoCo has the tool, shape (n, 4, 4)."""
    model = mujoco.MjModel.from_xml_string(body.mjcf)
    data, poses = mujoco.MjData(model), np.tile(np.eye(4), (len(postures), 1, 1))
    at = [model.joint(name).qposadr[0] for name in body.need(Arm).chain.joints]
    for pose, posture in zip(poses, postures, strict=True):
        data.qpos[at] = posture
        mujoco.mj_kinematics(model, data)
        pose[:3, :3], pose[:3, 3] = data.site("tool").xmat.reshape(3, 3), data.site("tool").xpos
    return poses


def postures_of(body: Body, count: int = 20) -> np.ndarray:
    """Return postures within the limits."""
    limits, dof = body.limits, body.need(Arm).chain.dof
    return np.random.default_rng(0).uniform(limits.lower[:dof], limits.upper[:dof], (count, dof))


VARIANTS = {
    "as it is": TEXT,
    "without a gripper": ARM_ONLY,
    "motors": MOTORS,
    "no actuators": BARE.replace('frictionloss="0.052"', 'frictionloss="0.052" actuatorfrcrange="-2.94 2.94"'),
    "a scene": TEXT.replace(
        "<worldbody>",
        '<worldbody><light pos="0 0 2"/><camera name="front" pos="1 0 1"/>'
        '<geom name="floor" type="plane" size="1 1 1"/>'
        '<body name="block" pos="0.3 0 1"><freejoint/><geom type="box" size="0.02 0.02 0.02"/></body>',
    ),
    "elsewhere": TEXT.replace('<body name="base">', '<body name="base" pos="1 2 0.7" euler="0 0 1.5707963">'),
}


@pytest.mark.parametrize("variant", VARIANTS)
def test_tool_and_torques_are_those_of_mujoco_and_home_is_free_and_before_the_arm(variant: str, folder: Path) -> None:
    body = built(folder, VARIANTS[variant])
    arm, postures = body.need(Arm), postures_of(body)
    np.testing.assert_allclose(ForwardKinematics(arm.chain).tool(postures), tool_poses(body, postures), atol=1e-6)
    model = mujoco.MjModel.from_xml_string(body.mjcf)
    data, rng = mujoco.MjData(model), np.random.default_rng(1)
    places = [model.joint(name) for name in arm.chain.joints]
    model.dof_frictionloss[:] = 0.0
    for posture in postures[:5]:
        speed, acceleration = rng.uniform(-1, 1, (2, arm.chain.dof))
        data.qpos[:], data.qvel[:], data.qacc[:] = model.qpos0, 0.0, 0.0
        if arm.gripper is not None:
            for name, value in zip(arm.gripper.joints, arm.gripper.opened, strict=True):
                data.qpos[model.joint(name).qposadr[0]] = value
        for place, one, two, three in zip(places, posture, speed, acceleration, strict=True):
            data.qpos[place.qposadr[0]], data.qvel[place.dofadr[0]] = one, two
            data.qacc[place.dofadr[0]] = three
        mujoco.mj_inverse(model, data)
        wanted = data.qfrc_inverse + data.qfrc_constraint
        found = ArmDynamics(body).torque(posture[None], speed[None], acceleration[None])[0]
        np.testing.assert_allclose(found, wanted[[place.dofadr[0] for place in places]], atol=2e-3)
    kinematics, home = ArmKinematics(arm.chain, arm.limits), np.array(arm.home[: arm.chain.dof])
    assert int(kinematics.check(home[None])[0]) == ResultCode.SUCCEEDED
    low, high = np.array(arm.workspace.tool)
    assert ((kinematics.tool(home)[:3, 3] > low) & (kinematics.tool(home)[:3, 3] < high)).all()


def test_however_the_file_is_written_it_is_the_same_arm(folder: Path) -> None:
    names = ("as it is", "a scene", "elsewhere")
    plain, scene, elsewhere = (built(folder, VARIANTS[name]).need(Arm) for name in names)
    for other in (scene, elsewhere):
        np.testing.assert_allclose(other.home, plain.home, atol=1e-5)
        np.testing.assert_allclose(other.limits.acceleration, plain.limits.acceleration, rtol=1e-4)
        assert other.chain.disjoint == plain.chain.disjoint
    degrees = re.sub(
        r'range="(-?[\d.]+) (-?[\d.]+)"',
        lambda found: f'range="{np.degrees(float(found[1])):.9g} {np.degrees(float(found[2])):.9g}"',
        TEXT.replace('forcerange="-2.94 2.94"', "FORCE").replace('angle="radian"', 'angle="degree"'),
    ).replace("FORCE", 'forcerange="-2.94 2.94"')
    degrees = degrees.replace('euler="0 -0.1745 0"', 'euler="0 -9.998 0"').replace(
        'euler="0 0.11 0"', 'euler="0 6.303 0"'
    )
    body = built(folder, degrees)
    turned, model = body.need(Arm), World(body).model
    np.testing.assert_allclose(turned.limits.upper, plain.limits.upper, atol=1e-5)
    ends = [model.joint(name).range[1] for name in turned.chain.joints]
    np.testing.assert_allclose(ends, turned.limits.upper[: len(ends)], atol=1e-9)


FLOOR = '<worldbody><geom name="floor" type="plane" size="1 1 1"/>'
ATTACHED = (
    '<mujoco><compiler angle="degree"/><asset><model name="child" file="child.xml"/></asset>'
    '<worldbody><frame><attach model="child" body="base" prefix="r_"/></frame></worldbody></mujoco>'
)
LINK = "v 0 0 0\nv 0.01 0 0\nv 0 0.01 0\nv 0 0 0.01\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


@each_case(
    "text",
    [
        TEXT.replace('<camera name="wrist" ', "<camera ")
        .replace(
            "<asset>",
            '<asset><texture name="sky" type="skybox" builtin="gradient" width="8" height="8"/>'
            '<material name="floor"/><material name="table"/><material name="leg"/>',
        )
        .replace("<worldbody>", FLOOR)
        .replace("</worldbody>", '</worldbody><contact><pair geom1="floor" geom2="moving_jaw"/></contact>')
        .replace("<actuator>", '<actuator><adhesion name="suck" body="jaw" gain="1" ctrlrange="0 1"/>'),
        TEXT.replace(
            '<position name="gripper" joint="gripper"/>',
            '<position name="gripper" joint="gripper" gear="2" kp="4.45" forcerange="-1.47 1.47"/>',
        ),
        TEXT.replace('autolimits="true"/>', 'autolimits="true" meshdir="assets" strippath="true"/>')
        .replace("<asset>", '<asset><mesh name="link" file="../other/link.obj"/>')
        .replace(
            '<geom name="stand"',
            '<geom name="link" type="mesh" mesh="link" mass="0" contype="0" conaffinity="0"/><geom name="stand"',
        ),
        ATTACHED,
    ],
)
def test_a_file_with_parts_that_are_not_the_arms_is_simulated_as_the_same_arm(text: str, folder: Path) -> None:
    body = built(folder, text)
    arm, wanted = body.need(Arm), built(folder, TEXT).need(Arm)
    np.testing.assert_allclose(arm.limits.effort, wanted.limits.effort, rtol=1e-6)
    np.testing.assert_allclose(arm.limits.upper, wanted.limits.upper, atol=1e-6)
    world = World(body)
    Tabletop(world).place([TableScene("task", (), arm.home)])
    ends = [world.model.joint(name).range[1] for name in arm.chain.joints]
    np.testing.assert_allclose(ends, arm.limits.upper[: arm.chain.dof], atol=1e-6)
    for _ in range(20):
        world.step()
    world.check()


OTHER = (
    '<body name="other" pos="0 1 0"><joint name="one" axis="0 0 1" range="-1 1"/><geom type="sphere" size="0.1"/>'
    '<body name="more" pos="0 0 0.2"><joint name="two" axis="0 0 1" range="-1 1"/><geom type="sphere" size="0.1"/>'
    '</body></body></worldbody><equality><joint joint1="one" joint2="two"/><tendon tendon1="both"/></equality>'
    '<tendon><fixed name="both"><joint joint="one" coef="1"/><joint joint="two" coef="1"/></fixed></tendon>'
)


@pytest.mark.law
def test_obstacles_are_kept_away_from_by_all_that_a_joint_moves(tmp_path: Path) -> None:
    wing = '<body name="shoulder"', '<geom type="capsule" fromto="0 -0.1 0 0 -0.2 0" size="0.01"/>'
    text = re.sub(rf"({wing[0]}[^>]*>)", rf"\1{wing[1]}", TEXT)
    file = written(tmp_path, text, tool="gripper_frame")
    arm = arm_body(file).need(Arm)
    chain, turned = arm.chain, np.array(arm.home[: arm.chain.dof])
    turned[0] += 1.5
    frames = ForwardKinematics(chain).frames(turned)
    assert any(one.radius < 0.012 and one.frame == 1 for one in chain.capsules)
    for capsule in [one for one in chain.capsules if one.frame > 1 or one.radius < 0.012]:
        place = frames[capsule.frame]
        point = tuple((place[:3, :3] @ capsule.end + place[:3, 3]).tolist())
        obstacle = Capsule("obstacle_0", 0, point, point, 0.002)
        seen = CollisionModel(arm_body(file, obstacles=(obstacle,)).need(Arm).chain)
        pairs = dict(zip(seen.chain.disjoint, seen.each(turned[None])[:, 0], strict=False))
        assert pairs["obstacle_0", capsule.name] < 0.0, capsule.name


def test_of_two_arms_in_a_file_what_couples_joints_of_the_other_is_left_out(folder: Path) -> None:
    model = World(built(folder, TEXT.replace("</worldbody>", OTHER), tool="gripper_frame")).model
    assert (model.neq, model.ntendon) == (0, 0)


@each_case(
    "default",
    [
        ('<position kp="17.8"', '<position kp="17.8" ctrlrange="-0.1 0.1"'),
        ('<position kp="17.8" forcerange="-2.94 2.94"/>', '<position kp="4.45" forcerange="-1.47 1.47" gear="2"/>'),
        ('<geom condim="3"', '<geom condim="3" priority="2" solref="0.1 1"'),
    ],
)
def test_defaults_of_a_file_are_those_of_its_robot_alone(default: tuple[str, str], folder: Path) -> None:
    plain, other = (World(built(folder, text)).model for text in (TEXT, TEXT.replace(*default)))
    for name in ("gear", "ctrllimited", "gainprm", "biasprm"):
        values = getattr(other, f"actuator_{name}"), getattr(plain, f"actuator_{name}")
        np.testing.assert_allclose(*values, rtol=1e-9)
    for name in ("table", "object_0"):
        ours, usual = other.geom(name), plain.geom(name)
        assert (ours.priority, *ours.solref, *ours.friction) == (usual.priority, *usual.solref, *usual.friction)


@each_case(
    ("there", "named"),
    [
        ('<camera name="wrist"', '<camera name="scene"'),
        ('<body name="base"', '<body name="table"'),
        ('<geom name="foot"', '<geom name="floor"'),
    ],
)
def test_a_name_of_our_scene_is_refused(there: str, named: str, folder: Path) -> None:
    body = built(folder, TEXT)
    assert there in body.mjcf
    with pytest.raises(ConfigError, match="Rename it in the file of the robot"):
        Tabletop(World(replace(body, mjcf=body.mjcf.replace(there, named))))


def test_speeds_of_a_urdf_are_those_of_its_limits(tmp_path: Path) -> None:
    path = tmp_path / "arm.urdf"
    path.write_text(
        '<robot name="arm"><joint name="one" type="revolute"><safety_controller k_velocity="40.0"/>'
        '<limit effort="87" lower="-1" upper="1" velocity="2.175"/></joint>'
        '<!-- <joint name="two"><limit velocity="9"/></joint> --></robot>',
        encoding="utf-8",
    )
    assert joint_speeds(str(path)) == {"one": 2.175}


@each_case("compiler", ["", '<mujoco><compiler meshdir="shapes" balanceinertia="true"/></mujoco>'])
def test_meshes_of_a_urdf_are_found_where_mujoco_looks_for_them(compiler: str, tmp_path: Path) -> None:
    folder, path = tmp_path / ("shapes" if compiler else "."), tmp_path / "arm.urdf"
    folder.mkdir(exist_ok=True)
    (folder / "link.obj").write_text(LINK, encoding="utf-8")
    mesh = '<geometry><mesh filename="package://my_arm/meshes/link.obj"/></geometry>'
    path.write_text(
        f'<robot name="arm">{compiler}<link name="base"><collision>{mesh}</collision></link></robot>', encoding="utf-8"
    )
    assert load_model(str(path)).compile().nmesh == 1


@each_case(
    ("text", "effort"),
    [
        (TEXT, ()),
        (TEXT.replace('frictionloss="0.052"', 'frictionloss="0.052" actuatorfrcrange="-1 1"'), (2.94,)),
    ],
)
def test_motors_give_the_torque_that_is_said_of_them_and_carry_the_arm_with_it(
    text: str, effort: tuple[float, ...], folder: Path
) -> None:
    body = built(folder, text, effort=effort) if effort else built(folder, text)
    world, joints = World(body), body.need(Arm).chain.joints
    torque, dofs = world.derived("qfrc_actuator"), world.joint_slice(joints)[1]
    for way in (-1.0, 1.0):
        world.reset()
        world.ctrl[0, : len(joints)] += way
        world.step()
        assert np.abs(torque[0, dofs]).max() == pytest.approx(2.94)


@each_case(
    "text",
    [
        TEXT,
        TEXT.replace('damping="0.6"', 'damping="0.6" stiffness="6" springref="0.8"').replace(
            '<geom condim="3"', '<geom condim="3" margin="0.05"'
        ),
    ],
)
def test_neither_springs_nor_margins_move_an_arm_that_is_held_over_the_table(text: str, folder: Path) -> None:
    body = built(folder, text)
    arm, pose = body.need(Arm), np.diag((1.0, -1.0, -1.0, 1.0))
    pose[:3, 3] = np.mean(arm.workspace.table, axis=0)[0], 0.0, arm.workspace.handling.lowest
    posture = ArmKinematics(arm.chain, arm.limits).solve(pose, np.array(arm.home[:-1])).postures[0]
    world = World(body)
    table = Tabletop(world)
    table.place([TableScene("low", (), (*posture, arm.home[-1]))])
    for _ in range(500):
        world.step()
    np.testing.assert_allclose(world.qpos[0, world.joint_slice(arm.chain.joints)[0]], posture, atol=2e-3)
    assert not table.arm_on_table.any()


@each_case(
    ("gripper", "at", "opening"),
    [
        (GripperFile(closed=-0.1745, open=0.85, opening=0.073), -0.1745, 0.0),
        (GripperFile(closed=-0.1745, open=0.85, opening=0.073), 0.85, 0.073),
        (GripperFile(closed=0.85, open=-0.1745, opening=0.05), 0.85, 0.0),  # the other way round
        (GripperFile(name="gripper", open=1.0, closed=0.0, opening=0.08), 0.5, 0.04),
    ],
)
def test_the_opening_is_read_and_commanded_in_metres(
    gripper: GripperFile, at: float, opening: float, folder: Path
) -> None:
    body = built(folder, TEXT, gripper=gripper)
    spec = body.need(GripperSpec)
    assert spec.joints_at(opening) == pytest.approx([at], abs=1e-6)
    world = World(body)
    plant, reading = SimulatedPlant(world), PlantReading(1, len(body.joints))
    command = np.array([[*body.need(Arm).home[:-1], opening]])
    for _ in range(1000):
        plant.write(command)
        world.step()
    plant.read(reading)
    np.testing.assert_allclose(reading.position, command, atol=0.004)
    assert world.qpos[0, world.joint_places(["gripper"])[0][0]] == pytest.approx(at, abs=0.05)


@each_case(
    ("text", "options", "message"),
    [
        ("<mujoco><worldbody><body", {}, "which MuJoCo cannot read"),
        (TEXT.replace('size="0.021" mass="0.048"', 'size="0.021 0.1 0.1" mass="-1"'), {}, "arm.xml"),
        (TEXT, {"tool": "gripper_fram"}, "Did you mean 'gripper_frame'"),
        (TEXT, {"tool": "upper_arm"}, r"has 2 joints before it \(shoulder_pan, shoulder_lift\).*robot.tool"),
        (TEXT.replace('<site name="gripper_frame" pos="0.0982 0 0.013"/>', ""), {"tool": "foot"}, "Sites|site or body"),
        (TEXT.replace('"elbow_flex" range', '"elbow_flex" type="slide" range'), {}, "elbow_flex.* is a slide"),
        (TEXT.replace('<body name="base">', '<body name="base"><freejoint/>'), {}, "is free or a ball"),
        (TEXT.replace('<joint name="elbow_flex" range="-1.69 1.69"/>', '<joint name="elbow_flex"/>'), {},
         r"no range for elbow_flex.*--robot.ranges='\{elbow_flex"),
        (TEXT, {"ranges": (("elbow", -1.0, 1.0),)}, "Did you mean 'elbow_flex'"),
        (TEXT, {"ranges": (("elbow_flex", 1.0, -1.0),)}, "the first must be smaller"),
        (TEXT.replace(' forcerange="-2.94 2.94"', ""), {}, "largest torque is not known.*--robot.effort"),
        (BARE, {}, "shoulder_pan' has no actuator.*--robot.effort"),
        (TEXT, {"effort": (1.0, 2.0)}, "robot.effort is .* or 5: one for each joint"),
        (TEXT, {"home": (float("nan"),) * 5}, r"robot.home is \[nan, .*finite numbers"),
        (TEXT, {"home": (0.0, 0.0)}, "robot.home has 2 numbers; the arm has 5 joints"),
        (TEXT, {"home": (0.0, 2.0, 0.0, 0.0, 0.0)}, "shoulder_lift is at 2.000 rad at home; its range is -1.745 to"),
        (TEXT, {"gripper": GripperFile(name="jaws")}, "Did you mean|gripper.*robot.gripper.name"),
        (TEXT, {"gripper": GripperFile(open=0.5, closed=0.5)}, "open and closed; they must differ"),
        (TEXT, {"gripper": GripperFile(open=2.5)}, r"robot.gripper.open is 2.5; the joint 'gripper' goes from -0.1745"),
        (TEXT, {"gripper": GripperFile(opening=-0.1)}, "robot.gripper.opening is -0.1"),
        (
            TEXT.replace("<actuator>", LOOP + "<actuator>"), {}, "closes a loop",
        ),
        (
            TEXT.replace(CAPSULE, 'type="mesh" mesh="link"').replace(
                "<asset>", '<asset><mesh name="link" file="link.stl"/>'
            ), {}, "link.stl",
        ),
        (
            TEXT.replace("</worldbody>", '<body name="other"><joint name="j" axis="0 0 1" range="-1 1"/>'
                         '<geom type="sphere" size="0.1"/></body></worldbody>'),
            {}, "more than one tree with joints: base, other.*robot.tool",
        ),
    ],
)  # fmt: skip
def test_what_is_wrong_or_missing_is_named_with_its_remedy(
    text: str, options: dict[str, object], message: str, tmp_path: Path
) -> None:
    with pytest.raises(ConfigError, match=f"(?s){message}"):
        arm_body(written(tmp_path, text, **options))


@pytest.mark.law
def test_a_file_that_is_not_there_is_named() -> None:
    with pytest.raises(ConfigError, match=r"'/nowhere/arm\.xml', and there is no such file"):
        arm_body(replace(SO101, path="/nowhere/arm.xml"))


def test_a_file_that_changes_is_read_again(tmp_path: Path) -> None:
    file = written(tmp_path, TEXT)
    before = arm_body(file)
    Path(file.path).write_text(TEXT.replace("-2.94 2.94", "-1.9 1.9"), encoding="utf-8")
    os.utime(file.path, (1, 1))
    assert before.limits.effort[0] == 2.94
    assert arm_body(file).limits.effort[0] == 1.9
