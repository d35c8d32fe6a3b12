"""Grasps from above, by geometry: across the narrow side, away from neighbours, above the table."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bhd_lerobot.bodies.body import Arm
from bhd_lerobot.bodies.tabletop import OBJECT_FIELDS
from bhd_lerobot.bodies.ur import MAX_OPENING, ur5
from bhd_lerobot.control.geometry.forward_kinematics import ForwardKinematics
from bhd_lerobot.policies.manipulation.grasp import SeenObject, neutral_yaw, plan_grasp, pointing_down, read_objects
from tests.cases import each_case

HANDLING = ur5().need(Arm).workspace.handling

angles = st.floats(-math.pi, math.pi)


def seen(kind: str, size: tuple, *, x: float = 0.5, y: float = 0.0, yaw: float = 0.0, index: int = 0) -> SeenObject:
    return SeenObject(index, kind, (x, y, size[2] / 2), yaw, size, (0.8, 0.1, 0.1), True)  # type: ignore[arg-type]


def box(length: float, width: float, **place: float) -> SeenObject:
    return seen("box", (length, width, 0.08), **place)


def cup(diameter: float = 0.06, height: float = 0.1, **place: float) -> SeenObject:
    return seen("cup", (diameter, diameter, height), **place)


def between_lines(first: float, second: float) -> float:
    """Return the angle between two lines [rad]."""
    return abs((first - second + math.pi / 2) % math.pi - math.pi / 2)


@pytest.mark.law
@given(angles, st.floats(0.09, 0.2), st.floats(0.01, 0.07))
def test_the_fingers_take_the_side_that_fits(yaw: float, wide: float, narrow: float) -> None:
    for length, width, across in ((wide, narrow, yaw + math.pi / 2), (narrow, wide, yaw)):
        grasp = plan_grasp(box(length, width, yaw=yaw), [], MAX_OPENING, handling=HANDLING)
        assert grasp is not None
        assert grasp.width == narrow
        assert between_lines(grasp.yaw, across) < 1e-9
        assert narrow < grasp.opening <= MAX_OPENING


@given(angles, st.floats(0.01, 0.09), st.floats(0.01, 0.09), st.floats(0, 0.03))
def test_wider_is_wider_where_the_gripper_can_and_a_side_that_leaves_less_is_left(yaw, length, width, wider):
    one = box(length, width, yaw=yaw)
    usual, wide = (plan_grasp(one, [], MAX_OPENING, handling=HANDLING, wider=more) for more in (0.0, wider))
    careful = plan_grasp(one, [], MAX_OPENING, handling=HANDLING, wider=wider, least=wider)
    assert (usual is None) == (wide is None)
    if usual is not None and wide is not None:
        assert wide == dataclasses.replace(usual, opening=min(MAX_OPENING, usual.opening + wider), room=wide.room)
    if careful is not None:
        assert careful.opening - careful.width >= wider
    else:
        assert min(length, width) + wider > MAX_OPENING - 0.01


@given(angles, st.floats(0.02, 0.07), st.floats(0.0, 0.03))
def test_fingers_that_are_opened_further_keep_the_object_in_their_middle_also_if_one_alone_moves(yaw, width, wider):
    for handling in (HANDLING, dataclasses.replace(HANDLING, fixed=0.013)):
        usual, wide = (
            plan_grasp(box(0.12, width, yaw=yaw), [], MAX_OPENING, handling=handling, wider=more)
            for more in (0.0, wider)
        )
        assert usual is not None
        assert wide is not None
        opened = usual.opened(wide.opening, handling)
        assert (opened.opening, opened.yaw) == (wide.opening, wide.yaw)
        assert (opened.x, opened.y) == pytest.approx((wide.x, wide.y), abs=1e-12)


@each_case("one", [box(0.09, 0.079), cup(0.079), box(0.3, 0.3)])
def test_what_fits_on_no_side_has_no_grasp(one: SeenObject) -> None:
    assert plan_grasp(one, [], MAX_OPENING, handling=HANDLING) is None


@given(angles, st.floats(0.3, 0.65), st.floats(-0.3, 0.3))
def test_a_box_turned_by_half_a_turn_is_the_same_box(yaw: float, x: float, y: float) -> None:
    one, two = (
        plan_grasp(box(0.08, 0.05, x=x, y=y, yaw=a), [], MAX_OPENING, handling=HANDLING) for a in (yaw, yaw + math.pi)
    )
    assert one is not None
    assert two is not None
    assert between_lines(one.yaw, two.yaw) < 1e-9
    assert dataclasses.replace(one, yaw=0.0) == dataclasses.replace(two, yaw=0.0)


@given(angles, angles, st.floats(0.3, 0.65), st.floats(-0.3, 0.3))
def test_of_two_ways_round_it_is_the_one_with_less_turn_of_the_wrist(yaw, other, x, y):
    for one in (box(0.08, 0.05, x=x, y=y, yaw=yaw), cup(x=x, y=y, yaw=other)):
        grasp = plan_grasp(one, [], MAX_OPENING, handling=HANDLING)
        assert grasp is not None
        assert abs(grasp.yaw - neutral_yaw(x, y, HANDLING)) <= math.pi / 2 + 1e-9


def test_at_home_the_wrist_is_not_turned() -> None:
    arm = ur5()
    tool = ForwardKinematics(arm.arm.chain).tool(np.array(arm.arm.home[:6]))
    fingers = math.atan2(tool[1, 1], tool[0, 1])  # the tool's y axis: from the left to the right finger
    assert between_lines(fingers, neutral_yaw(*tool[:2, 3], HANDLING)) < 1e-6


def test_a_cup_alone_is_taken_with_next_to_no_turn() -> None:
    for y in (-0.3, 0.0, 0.2):
        grasp = plan_grasp(cup(y=y), [], MAX_OPENING, handling=HANDLING)
        assert grasp is not None
        assert between_lines(grasp.yaw, neutral_yaw(0.5, y, HANDLING)) <= math.pi / 24 + 1e-9


def fingers(grasp) -> np.ndarray:
    """Return the places of both open fingers, shape (2, 2): where the inner faces stand."""
    pose = grasp.pose(grasp.z).matrix()
    return np.stack([pose[:2, 3] + sign * grasp.opening / 2 * pose[:2, 1] for sign in (-1, 1)])


@given(st.integers(0, 2**32 - 1))
def test_fingers_never_stand_in_a_neighbour_when_another_way_has_room(seed: int) -> None:
    rng = np.random.default_rng(seed)
    target = cup(0.06, x=0.5, y=0.0)
    others = []
    for index in range(1, 4):
        angle, distance = rng.uniform(-math.pi, math.pi), rng.uniform(0.08, 0.16)
        place = {"x": 0.5 + distance * math.cos(angle), "y": distance * math.sin(angle)}
        others.append(cup(0.05, **place, index=index))
    grasp = plan_grasp(target, others, MAX_OPENING, handling=HANDLING)
    assert grasp is not None

    def room(line: float) -> float:
        tips = [
            np.array([0.5, 0.0]) + s * (grasp.opening / 2 + 0.018) * np.array([math.cos(line), math.sin(line)])
            for s in (-1, 1)
        ]
        return min(np.linalg.norm(tip - other.position[:2]) - 0.025 - 0.018 for tip in tips for other in others)

    assert grasp.room == pytest.approx(min(room(grasp.yaw), math.inf), abs=1e-9)
    best = max(room(math.pi * k / 12) for k in range(12))
    assert grasp.room >= min(best, 0.025) - 1e-9
    if best > 0:
        for tip in fingers(grasp):
            assert min(np.linalg.norm(tip - other.position[:2]) for other in others) > 0.025


@given(st.floats(0.3, 0.7), st.floats(-0.4, 0.4), st.floats(0.1, 0.5), st.floats(-10, 10))
def test_the_tool_points_straight_down_with_its_fingers_on_the_line(x: float, y: float, z: float, yaw: float) -> None:
    matrix = pointing_down(x, y, z, yaw).matrix()
    assert matrix[:3, 3].tolist() == [x, y, z]
    assert np.allclose(matrix[:3, 2], [0, 0, -1], atol=1e-12)
    assert np.allclose(matrix[:3, 1], [math.cos(yaw), math.sin(yaw), 0], atol=1e-9)
    assert np.linalg.det(matrix[:3, :3]) == pytest.approx(1)


@given(st.floats(0.005, 0.3))
def test_finger_tips_stay_above_the_table_and_the_palm_above_the_object(height: float) -> None:
    grasp = plan_grasp(cup(height=height), [], MAX_OPENING, handling=HANDLING)
    assert grasp is not None
    assert grasp.z - 0.014 >= 0.01 - 1e-12  # the tips reach 14 mm farther than the tool centre point
    assert grasp.z + 0.055 >= height - 1e-12
    if height > 0.024:
        assert grasp.z - 0.014 < height  # and there is something between the fingers
    assert grasp.pose(0.2).position == (grasp.x, grasp.y, 0.2)


def row(**values: float) -> list[float]:
    usual = {"present": 1.0, "qw": 1.0, "x": 0.5, "z": 0.05, "length": 0.06, "width": 0.06, "height": 0.1}
    return [{**usual, **values}.get(name, 0.0) for name in OBJECT_FIELDS]


def test_objects_are_read_by_their_places() -> None:
    table = np.array([row(present=0), row(box=1, target=1, y=0.1), row(red=0.5)])
    objects = read_objects(table)
    assert [(one.index, one.kind, one.target) for one in objects] == [(1, "box", True), (2, "cup", False)]
    assert objects[0].position == (0.5, 0.1, 0.05)
    assert objects[1].colour == (0.5, 0.0, 0.0)


@given(angles)
def test_the_yaw_is_the_quaternion_s_whatever_its_sign(yaw: float) -> None:
    for sign in (-1, 1):
        table = np.array([row(qw=sign * math.cos(yaw / 2), qz=sign * math.sin(yaw / 2))])
        assert math.cos(read_objects(table)[0].yaw - yaw) == pytest.approx(1)


@each_case("name", OBJECT_FIELDS)
@each_case("value", [math.nan, math.inf])
def test_what_is_not_a_number_was_not_seen(name: str, value: float) -> None:
    assert [one.index for one in read_objects(np.array([row(**{name: value}), row()]))] == [1]
