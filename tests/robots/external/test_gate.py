"""The gate in front of another package's robot, at what it lets through."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bhd_lerobot.control.messages import Limit
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.robots.external.config import GateConfig
from bhd_lerobot.robots.external.gate import Gate
from tests.cases import each_case

NAMES = ("arm.pos", "x.vel")
RANGE = {"arm.pos": [-90.0, 90.0], "x.vel": [-0.3, 0.3]}
ANY = st.one_of(st.floats(-500, 500), st.sampled_from([math.nan, math.inf, -math.inf]))


@pytest.mark.law
@given(st.lists(st.tuples(ANY, ANY), min_size=1, max_size=40), st.floats(-120, 120))
def test_whatever_comes_is_finite_in_range_and_near_to_what_was_before(
    stream: list[tuple[float, float]], measured: float
) -> None:
    gate = Gate(NAMES, GateConfig(range=RANGE, max_change={"arm.pos": 5.0, "x.vel": 0.1}), {})
    gate.begin(np.array([measured, math.nan]))
    before = np.array([measured, 0.0])
    for action in stream:
        passed = gate.passed(np.array(action))
        assert np.isfinite(passed.action).all()
        assert (np.abs(passed.action - before) <= np.array([5.0, 0.1]) + 1e-9).all()
        # From outside of the range it comes back, never further away.
        room = np.array([max(90.0, abs(before[0])), 0.3])
        assert (np.abs(passed.action) <= room + 1e-9).all()
        changed = passed.action != np.array(action)
        assert bool(passed.limits) == bool(changed.any())
        assert bool(passed.limits & Limit.NON_FINITE) == (not np.isfinite(action).all())
        before = passed.action


def test_what_fits_passes_unchanged() -> None:
    gate = Gate(NAMES, GateConfig(range=RANGE, max_change=5.0), {})
    gate.begin(np.array([0.0, math.nan]))
    for action in ([1.0, 0.3], [5.5, -0.3], [1.0, 0.0]):
        passed = gate.passed(np.array(action))
        assert passed.action.tolist() == action
        assert passed.limits == 0


def test_without_a_measurement_the_first_position_is_free_and_speeds_hold_at_zero() -> None:
    gate = Gate(NAMES, GateConfig(max_change=5.0), {})
    gate.begin(np.array([math.nan, math.nan]))
    assert np.array_equal(gate.holding(), [math.nan, 0.0], equal_nan=True)
    assert not np.isfinite(gate.passed(np.array([math.nan, 1.0])).action).all()  # nothing is known that could be sent
    assert gate.passed(np.array([70.0, 1.0])).action.tolist() == [70.0, 1.0]
    assert gate.passed(np.array([math.nan, 1.0])).action.tolist() == [70.0, 1.0]
    assert gate.holding().tolist() == [70.0, 0.0]


def test_ranges_come_from_the_options_before_the_calibration() -> None:
    gate = Gate(NAMES, GateConfig(range={"arm": {"pos": [-1.0, 1.0]}}), {"arm.pos": (-5.0, 5.0), "x.vel": (-2.0, 2.0)})
    assert gate.lower.tolist() == [-1.0, -2.0]
    assert gate.unlimited() == []
    assert Gate(NAMES, GateConfig(), {}).unlimited() == list(NAMES)
    assert np.isinf(Gate(NAMES, GateConfig(max_change={}), {}).max_change).all()


@each_case(
    ("options", "message"),
    [
        ({"range": {"arm.pos": [1, 0]}}, r"gate.range.arm.pos is \[1, 0\]"),
        ({"range": {"arm.pos": 3}}, "gate.range.arm.pos is 3"),
        ({"range": {"arm.pos": [0, math.inf]}}, "gate.range.arm.pos"),
        ({"max_change": 0}, "gate.max_change is 0"),
        ({"max_change": {"arm.pos": -1}}, "gate.max_change.arm.pos is -1"),
        ({"max_change": True}, "gate.max_change is True"),
        ({"brain_timeout_s": 0}, "gate.brain_timeout_s is 0"),
        ({"call_timeout_s": math.nan}, "gate.call_timeout_s"),
        ({"range": {"arn.pos": [0, 1]}}, "arn.pos.*arm.pos"),
        ({"max_change": {"y.vel": 1}}, "y.vel.*x.vel"),
    ],
)
def test_wrong_options_are_named(options: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        Gate(NAMES, GateConfig(**options), {})


SPEEDS = ("x.vel", "linear_velocity", "mobile_base.vx", "mobile_base.vtheta", "wheel_speed", "linear.x", "yaw_rate")
GO_ON = (*SPEEDS, "cmd_vel.angular", "twist.linear.x", "delta_x", "ee.delta.z", "remote.lx")
POSITIONS = (
    "linear_rail.pos",
    "ee.x",
    "ee.wx",
    "angular_joint.pos",
    "level.pos",
    "lx.pos",
    "accelerate",
    "deltoid.pos",
)


@each_case("name", GO_ON)
def test_a_speed_holds_at_zero_however_its_robot_names_it(name: str) -> None:
    gate = Gate((name, "level.pos"), GateConfig(), {})
    gate.begin(np.array([0.4, 2.0]))
    gate.passed(np.array([0.5, 3.0]))
    assert gate.has_speeds
    assert gate.holding().tolist() == [0.0, 3.0]


@each_case("name", POSITIONS)
def test_what_is_a_position_is_held_where_it_is(name: str) -> None:
    gate = Gate((name,), GateConfig(), {})
    gate.begin(np.array([2.0]))
    assert not gate.has_speeds
    assert gate.stop(np.array([3.0])).tolist() == [3.0]


def test_after_a_hold_a_speed_rises_from_zero() -> None:
    gate = Gate(NAMES, GateConfig(max_change={"x.vel": 0.1}), {})
    gate.begin(np.array([0.0, 0.0]))
    for speed in (0.1, 0.2, 0.3):
        assert gate.passed(np.array([0.0, speed])).action[1] == pytest.approx(speed)
    assert gate.hold()[1] == 0.0
    assert gate.passed(np.array([0.0, 0.3])).action[1] == pytest.approx(0.1)


GRIPS = ("gripper", "left_gripper", "rightGripper", "GRIPPER_L", "hand", "panda_finger_joint1", "jaw", "index_flexor")


@each_case("name", GRIPS)
def test_what_grips_keeps_its_position_in_an_emergency_stop(name: str) -> None:
    gate = Gate(("wrist.pos", name, "x.vel"), GateConfig(), {})
    gate.begin(np.zeros(3))
    gate.passed(np.array([8.0, 1.0, 0.5]))
    assert gate.stop(np.array([5.0, 4.0, 0.3])).tolist() == [5.0, 1.0, 0.0]
    assert gate.stop(np.array([np.nan, 4.0, 0.3])).tolist() == [5.0, 1.0, 0.0]


@each_case("name", GRIPS)
def test_what_grips_still_has_its_position_when_an_episode_begins(name: str) -> None:
    gate = Gate(("wrist.pos", name), GateConfig(max_change=5.0), {})
    gate.begin(np.array([0.0, 60.0]))
    gate.passed(np.array([1.0, 55.0]))
    gate.begin(np.array([3.0, 58.0]))  # as thick as what it holds
    assert gate.holding().tolist() == [3.0, 55.0]
    assert gate.passed(np.array([3.0, 45.0])).action.tolist() == [3.0, 50.0]


@each_case(
    ("last", "measured", "stop"), [(40.0, 57.3, 50.0), (40.0, -57.3, -50.0), (40.0, 45.0, 45.0), (None, 57.0, 57.0)]
)
def test_an_emergency_stop_does_not_leave_the_range(last: float | None, measured: float, stop: float) -> None:
    gate = Gate(("arm.pos",), GateConfig(range={"arm.pos": [-50.0, 50.0]}), {})
    gate.begin(np.array([measured]))
    if last is not None:
        gate.passed(np.array([last]))
    assert gate.stop(np.array([measured])).tolist() == [stop]
