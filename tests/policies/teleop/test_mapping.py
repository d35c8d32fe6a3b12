"""From a teleoperator's action to a robot's."""

import math
from dataclasses import replace
from typing import Any

import pytest

from bhd_lerobot.bodies.body import Drive
from bhd_lerobot.bodies.turtlebot3 import turtlebot3_burger
from bhd_lerobot.errors import ActionError, ConfigError
from bhd_lerobot.policies.teleop.mapping import ActionMap, Pair
from tests.cases import each_case

ROVER = ("linear_velocity", "angular_velocity")
BASE = ("x.vel", "theta.vel")
LEADER = ("shoulder_pan.pos", "gripper.pos")


BURGER = turtlebot3_burger().drive
FASTER = replace(BURGER, limits=replace(BURGER.limits, velocity=(0.5, 3.0)))
KNOWN = Pair("keyboard_rover", "turtlebot3", same_project=False, drive=BURGER)


@each_case(("drive", "largest"), [(BURGER, (0.22, 2.84)), (FASTER, (0.5, 3.0))])
def test_shares_of_the_largest_speeds_need_no_map(drive: Drive, largest: tuple[float, float]) -> None:
    mapped = ActionMap({}, replace(KNOWN, drive=drive), ROVER, BASE)
    action = mapped({"linear_velocity": 1.0, "angular_velocity": -0.5})
    assert action == {"x.vel": largest[0], "theta.vel": -0.5 * largest[1]}


def test_units_scales_and_offsets() -> None:
    asked = {
        "shoulder_pan.pos": {"from": "shoulder_pan.pos", "scale": "deg_to_rad"},
        "gripper.pos": {"scale": 0.001, "offset": 0.01},
    }
    mapped = ActionMap(asked, Pair("so101_leader", "ur5", same_project=False), LEADER, LEADER)
    action = mapped({"shoulder_pan.pos": 180.0, "gripper.pos": 50.0})
    assert action == {"shoulder_pan.pos": pytest.approx(math.pi), "gripper.pos": pytest.approx(0.06)}
    renamed = ActionMap(
        {"x.vel": "linear_velocity", "theta.vel": "angular_velocity"}, Pair("a", "b", same_project=False), ROVER, BASE
    )
    assert renamed({"linear_velocity": 3, "angular_velocity": 4}) == {"x.vel": 3.0, "theta.vel": 4.0}


def test_equal_names_are_no_proof_across_projects_and_enough_within_one() -> None:
    with pytest.raises(
        ConfigError, match=r"so101_leader and ur5 both have 'shoulder_pan.pos'.*degrees.*--map.shoulder_pan.pos="
    ):
        ActionMap({}, Pair("so101_leader", "ur5", same_project=False), LEADER, LEADER)
    within = ActionMap({}, Pair("so101_leader", "so101_follower", same_project=True), LEADER, LEADER)
    assert within({"shoulder_pan.pos": 5, "gripper.pos": 1}) == {"shoulder_pan.pos": 5.0, "gripper.pos": 1.0}


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ({"y.vel": "linear_velocity"}, "y.vel.*x.vel"),
        ({"x.vel": "linear"}, "linear.*linear_velocity"),
        ({"x.vel": {"from": "linear_velocity", "factor": 2}}, "factor.*scale"),
        ({"x.vel": {"from": "linear_velocity", "scale": "deg"}}, "map.x.vel.scale is 'deg'.*deg_to_rad"),
        ({"x.vel": {"from": "linear_velocity", "scale": math.inf}}, "map.x.vel.scale"),
        ({"x.vel": {"from": "linear_velocity", "scale": [1]}}, r"map.x.vel.scale is \[1\]"),
        ({"x.vel": 3}, "map.x.vel is 3"),
        ({}, "It is not known where .*'x.vel'.*linear_velocity"),
    ],
)
def test_a_wrong_map_is_named(asked: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        ActionMap(asked, Pair("keyboard_rover", "other", same_project=False), ROVER, BASE)


@pytest.mark.parametrize("given", [{"linear_velocity": 1.0}, {"linear_velocity": "fast", "angular_velocity": 0.0}])
def test_a_wrong_action_is_named(given: dict[str, Any]) -> None:
    mapped = ActionMap({}, KNOWN, ROVER, BASE)
    with pytest.raises(ActionError, match=r"angular_velocity|fast"):
        mapped(given)
