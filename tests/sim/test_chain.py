"""The geometry of arms that are read from models, beside the engine that simulates these."""

from dataclasses import replace
from itertools import product

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Placement
from bhd_lerobot.control.geometry.capsules import left_out
from bhd_lerobot.control.geometry.collision import CollisionModel
from bhd_lerobot.control.geometry.forward_kinematics import ForwardKinematics
from bhd_lerobot.control.record import SHAPES
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.sim.chain import chain_from_mjcf
from tests.cases import each_case
from tests.control.geometry.arm_models import serial

RNG = np.random.default_rng(5)
FRAME = '<geom type="sphere" size="0.01"/>'
TETRAHEDRON = "0 0 0  0.1 0 0  0 0.06 0  0 0 0.15"
SHAPES_OF_ALL_KINDS = (
    '<geom name="ball" type="sphere" size="0.04" pos="0.01 0 0.02"/>'
    '<geom name="pill" type="capsule" size="0.03 0.05" euler="0.3 0.2 0.1"/>'
    '<geom name="can" type="cylinder" size="0.03 0.08" pos="0 0.01 0.05" euler="1 0.2 0.1"/>'
    '<geom name="brick" type="box" size="0.02 0.09 0.03" euler="0.1 0.5 0.9"/>'
    '<geom name="egg" type="ellipsoid" size="0.03 0.05 0.09" euler="0.6 0.5 0.2"/>'
    '<geom name="wedge" type="mesh" mesh="wedge" pos="0.02 0 0.1" euler="0.4 0.1 0.3"/>'
)
MESH = f'<asset><mesh name="wedge" vertex="{TETRAHEDRON}"/></asset>'


def in_frame(data: mujoco.MjData, kind: str, name: str) -> NDArray[np.float64]:
    pose, found = np.eye(4), getattr(data, kind)(name)
    pose[:3, :3], pose[:3, 3] = found.xmat.reshape(3, 3), found.xpos
    return pose


def arm(joints: int, inside: str = "") -> str:
    """An arm whose axes are parallel to x and y by turns, with something in its last link."""
    links = "".join(
        f'<body name="link_{k}" pos="0 0 0.3"><joint name="joint_{k}" axis="{k % 2} {1 - k % 2} 0" range="-2 2"/>'
        '<geom type="capsule" fromto="0 0 0.05 0 0 0.2" size="0.03"/>'
        for k in range(joints)
    )
    return (
        f'<mujoco><compiler angle="radian"/>{MESH}<worldbody><body name="base"><geom type="box" size="0.1 0.1 0.05"/>'
        f'{links}<site name="tool" pos="0 0 0.3"/>{inside}{"</body>" * joints}</body></worldbody>%s</mujoco>'
    )


@pytest.mark.law
@pytest.mark.parametrize("joints", [4, 5, 6, 7])
@pytest.mark.parametrize(("degree", "ref"), [(False, False), (True, False), (False, True), (True, True)])
def test_frames_and_jacobian_are_those_of_the_engine(joints: int, degree: bool, ref: bool) -> None:
    document = serial(joints, joints, degree=degree, ref=ref)
    model = mujoco.MjModel.from_xml_string(document)
    chain = chain_from_mjcf(document, "tool")
    assert chain.joints == tuple(f"joint_{k}" for k in range(joints))
    forward, data = ForwardKinematics(chain), mujoco.MjData(model)
    for q in RNG.uniform(-2, 2, (20, joints)):
        data.qpos[:joints] = q
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mount = in_frame(data, "body", "mount")
        np.testing.assert_allclose(mount @ forward.tool(q), in_frame(data, "site", "tool"), atol=1e-12)
        jacobian = np.zeros((2, 3, model.nv))
        mujoco.mj_jacSite(model, data, *jacobian, model.site("tool").id)
        mine = mount[:3, :3] @ forward.jacobian(q).reshape(2, 3, joints)
        np.testing.assert_allclose(mine, jacobian[:, :, :joints], atol=1e-12)
        assert np.linalg.norm(forward.tool(q)[:3, 3]) < chain.reach


def test_a_root_farther_out_leaves_out_the_joints_before_it() -> None:
    document = serial(6)
    chain = chain_from_mjcf(document, "tool", root="link_1")
    assert chain.joints == tuple(f"joint_{k}" for k in range(2, 6))
    of_hand = chain_from_mjcf(document, ("hand", Placement((0.0, 0.0, 0.1))), root="link_1")
    q = RNG.uniform(-1, 1, 4)
    hand, tool = (ForwardKinematics(one).tool(q) for one in (of_hand, chain))
    assert not np.allclose(hand, tool)


@pytest.mark.law
def test_capsules_enclose_the_shapes_closely() -> None:
    """Points of the surface are inside, and no capsule has more than four times the volume of the box around it."""
    model = mujoco.MjModel.from_xml_string(arm(4, SHAPES_OF_ALL_KINDS) % "")
    chain = chain_from_mjcf(model, "tool")
    capsules = {capsule.name: capsule for capsule in chain.capsules}
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    last = in_frame(data, "body", "base") @ ForwardKinematics(chain).frames(np.zeros(4))[4]
    for name in ("ball", "pill", "can", "brick", "egg", "wedge"):
        capsule, pose = capsules[name], in_frame(data, "geom", name)
        start, end = (last[:3, :3] @ point + last[:3, 3] for point in (capsule.start, capsule.end))
        inside = 0
        directions = RNG.normal(size=(300, 3))
        for direction in directions / np.linalg.norm(directions, axis=1, keepdims=True):  # from outside to the middle
            geom = np.zeros(1, np.int32)
            origin = pose[:3, 3] + 2.0 * direction
            far = mujoco.mj_ray(model, data, origin, -direction, None, 1, -1, geom)
            point = origin - far * direction
            if geom[0] != model.geom(name).id:
                continue
            inside += 1
            share = np.clip((point - start) @ (end - start) / max((end - start) @ (end - start), 1e-12), 0, 1)
            assert np.linalg.norm(point - start - share * (end - start)) < capsule.radius + 1e-6
        assert inside > 10
        volume = np.pi * capsule.radius**2 * (np.linalg.norm(end - start) + 4 / 3 * capsule.radius)
        assert volume < 4 * 8 * np.prod(model.geom_aabb[model.geom(name).id, 3:])
    np.testing.assert_allclose((capsules["ball"].radius, capsules["pill"].radius), (0.04, 0.03))
    np.testing.assert_allclose(np.linalg.norm(np.subtract(capsules["pill"].end, capsules["pill"].start)), 0.1)


def test_a_crooked_mesh_is_enclosed_by_two_capsules() -> None:
    """Every point of its hull is in one of them."""
    box = np.array(list(product((-1.0, 1.0), repeat=3)))
    points = np.concatenate((box * (0.02, 0.02, 0.1) + (0.0, 0.0, 0.1), box * (0.09, 0.02, 0.02) + (0.07, 0.0, 0.2)))
    vertices = " ".join(map(str, points.ravel()))
    mesh, geom = f'<asset><mesh name="ell" vertex="{vertices}"/></asset>', '<geom name="ell" type="mesh" mesh="ell"/>'
    model = mujoco.MjModel.from_xml_string((arm(4, geom) % "").replace("<worldbody>", f"{mesh}<worldbody>", 1))
    chain = chain_from_mjcf(model, "tool")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    last = np.linalg.inv(ForwardKinematics(chain).frames(np.zeros(4))[4]) @ in_frame(data, "body", "link_3")
    capsules = [capsule for capsule in chain.capsules if capsule.name in ("ell", "ell_2")]
    assert len(capsules) == 2
    inside = RNG.dirichlet(np.full(16, 0.3), 500) @ points @ last[:3, :3].T + last[:3, 3]
    depths = []
    for capsule in capsules:
        start, way = np.array(capsule.start), np.subtract(capsule.end, capsule.start)
        share = np.clip((inside - start) @ way / max(way @ way, 1e-12), 0, 1)
        depths.append(np.linalg.norm(inside - start - share[:, None] * way, axis=1) - capsule.radius)
    assert np.min(depths, axis=0).max() < 1e-6


def test_the_pairs_that_are_checked_can_meet_and_do_not_at_home() -> None:
    chain = chain_from_mjcf(arm(5) % "", "tool")
    frames = {capsule.name: capsule.frame for capsule in chain.capsules}
    assert chain.disjoint
    assert all(abs(frames[one] - frames[other]) > 1 for one, other in chain.disjoint)
    model = CollisionModel(chain)
    assert float(model.distances(np.zeros(5))[0]) >= chain.min_distance
    near = np.concatenate([model.each(RNG.uniform(-2, 2, (100, 5)))[: len(chain.disjoint)] for _ in range(20)], axis=1)
    assert ((near < 0.05).any(axis=1)).all()
    folded = {"joint_1": 1.9, "joint_2": 1.9, "joint_3": 1.9}
    assert len(chain_from_mjcf(arm(5) % "", "tool", home=folded).disjoint) < len(chain.disjoint)
    key = '<keyframe><key name="home" qpos="0 1.9 1.9 1.9 0"/></keyframe>'
    assert chain_from_mjcf(arm(5) % key, "tool").disjoint == chain_from_mjcf(arm(5) % "", "tool", home=folded).disjoint


def test_a_zero_that_no_joint_may_take_is_no_home() -> None:
    """With link 2 folded back at its zero more links touch than in the middle of its range."""
    plain = '<body name="link_2" pos="0 0 0.3"><joint name="joint_2" axis="0 1 0" range="-2 2"/>'
    folded = '<body name="link_2" pos="0 0 0.3" euler="3.1 0 0"><joint name="joint_2" axis="1 0 0" range="0.5 3"/>'
    document = (arm(5) % "").replace(plain, folded)
    chain = chain_from_mjcf(document, "tool")
    assert chain == chain_from_mjcf(document, "tool", home={"joint_2": 1.75})
    assert len(chain.disjoint) > len(chain_from_mjcf(document, "tool", home={"joint_2": 0.0}).disjoint)


def test_what_collides_is_enclosed_where_something_does_and_both_ends_of_a_finger() -> None:
    seen = '<geom name="seen" type="sphere" size="0.2" contype="0" conaffinity="0"/>'
    finger = (
        '<body><joint name="finger" type="slide" axis="0 1 0" range="0 0.05"/><geom name="pad" size="0.01"/></body>'
    )
    names = {capsule.name: capsule for capsule in chain_from_mjcf(arm(4, seen + finger) % "", "tool").capsules}
    assert "seen" not in names
    assert np.linalg.norm(np.subtract(names["pad"].start, names["pad_2"].start)) == pytest.approx(0.05)
    ghost = (arm(4, seen) % "").replace('type="capsule"', 'type="capsule" contype="0" conaffinity="0"')
    assert "seen" in {capsule.name for capsule in chain_from_mjcf(ghost, "tool").capsules}


def test_an_arm_of_many_shapes_fits_a_record() -> None:
    chain = chain_from_mjcf(arm(6, "".join(f'<geom size="0.01" pos="0 0 {k / 500}"/>' for k in range(80))) % "", "tool")
    assert len(chain.capsules) <= SHAPES
    assert len([capsule for capsule in chain.capsules if capsule.frame == 6]) == 2


TURN = "<joint name='{}' axis='0 0 1'/>" + FRAME
ARM = arm(4) % ""


@each_case(
    ("document", "tool", "root", "message"),
    [
        ("<mujoco", "tool", None, "does not compile"),
        (ARM, "tol", None, "'tol'.*'tool'"),
        (ARM.replace('<site name="tool" pos="0 0 0.3"/>', ""), "tool", None, "no sites.*name a body"),
        (ARM, ("lnk_3", Placement()), None, "'lnk_3'.*'link_3'"),
        (ARM, "tool", "bas", "'bas'.*'base'"),
        (ARM, "tool", "link_3", "no joint between.*root before"),
        (
            ARM.replace('<site name="tool"', f'<body name="side">{FRAME}</body><site name="tool"'),
            "tool",
            "side",
            "not on",
        ),
        (ARM.replace('"joint_2"', '"joint_2" type="slide"'), "tool", None, "'joint_2'.*slide joint.*root behind"),
        (ARM.replace('"joint_2" axis="0 1 0" range="-2 2"', '"joint_2" type="ball"'), "tool", None, "'joint_2'.*ball"),
        (ARM.replace('name="joint_2" ', ""), "tool", None, "'link_2'.*no name"),
        (arm(8) % "", "tool", None, "8 joints.*7 is the most"),
        (
            ARM.replace("</worldbody>", f"<body>{TURN.format('other')}</body></worldbody>"),
            *("tool", None, "'other' is in another tree.*root="),
        ),
        (
            ARM.replace('<body name="link_1"', f'<body>{TURN.format("left")}</body><body name="link_1"'),
            *("tool", None, "'left' is on a branch.*root="),
        ),
        (
            arm(4) % '<equality><connect name="rod" body1="link_1" body2="link_3" anchor="0 0 0"/></equality>',
            *("tool", None, "'rod' closes a loop.*'link_1' and 'link_3'"),
        ),
        (
            arm(4) % '<equality><joint name="belt" joint1="joint_1" joint2="joint_2"/></equality>',
            *("tool", None, "'belt' couples.*'joint_1'"),
        ),
    ],
)
def test_what_is_no_arm_is_refused_by_name_with_a_remedy(
    document: str, tool: str | tuple[str, Placement], root: str | None, message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        chain_from_mjcf(document, tool, root=root)


def test_a_scene_around_the_arm_is_no_part_of_it() -> None:
    scene = ARM.replace(
        "</worldbody>", f'<geom type="plane" size="1 1 1"/><body name="cup"><freejoint/>{FRAME}</body></worldbody>'
    )
    assert chain_from_mjcf(scene, "tool") == chain_from_mjcf(ARM, "tool")
    assert chain_from_mjcf(scene, "tool", root="world") == chain_from_mjcf(ARM, "tool", root="world")
    two = ARM.replace("</worldbody>", f"<body>{TURN.format('other')}</body></worldbody>")
    assert chain_from_mjcf(two, "tool", root="base") == chain_from_mjcf(ARM, "tool")


def test_no_link_is_taken_for_an_obstacle_or_for_what_is_held() -> None:
    named = ARM.replace('<geom type="capsule"', '<geom name="held_part" type="capsule"', 1)
    assert "link_held_part" in {capsule.name for capsule in chain_from_mjcf(named, "tool").capsules}


def test_a_home_of_joints_that_are_not_there_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"'joint_9'"):
        chain_from_mjcf(ARM, "tool", home={"joint_9": 0.0})


@pytest.mark.law
@pytest.mark.parametrize(("joints", "seed"), [(6, 0), (7, 0), (7, 2)])
def test_shapes_whose_distance_is_not_checked_do_not_meet(joints: int, seed: int) -> None:
    model = mujoco.MjModel.from_xml_string(serial(joints, seed))
    chain, (lower, upper) = chain_from_mjcf(model, "tool"), model.jnt_range[:joints].T
    pairs = left_out(chain)
    unchecked, rng = CollisionModel(replace(chain, disjoint=pairs)), np.random.default_rng(1)
    apart = unchecked.each(np.zeros((1, joints)))[: len(pairs), 0] >= chain.min_distance  # at home
    for _ in range(200):
        distances = unchecked.each(rng.uniform(lower, upper, (500, joints)))[: len(pairs)]
        assert (distances[apart] > 0.0).all()
