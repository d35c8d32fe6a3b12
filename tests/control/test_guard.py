"""Whatever is asked for, the guard's own answers keep the limits of the wire, to the end of a range and back."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Drive
from bhd_lerobot.bodies.turtlebot3_manipulation import turtlebot3_manipulation
from bhd_lerobot.control import kernels
from bhd_lerobot.control.guard import WireLimits, guard
from bhd_lerobot.control.record import LIMITS, new_states, put

TICKS, RANGE, CHANGE, HZ = 400, 1.0, 0.04, 500


def joints(bend: float) -> tuple[NDArray, Any, Any]:
    """Return the record of a robot with two joints, as an array and as the guard takes it, and its limits."""
    states, numbers = new_states(1), np.zeros(1, LIMITS)
    numbers["joints"] = 2
    for name, most in (("lower", -RANGE), ("upper", RANGE), ("change", CHANGE), ("bend", bend)):
        put(numbers, name, np.full((1, 2), most))
    [state], [limits] = kernels.as_objects(states), kernels.as_objects(numbers)
    return states, state, limits


@pytest.mark.law
@pytest.mark.parametrize("bend", [0.001, 0.0037, 0.04, np.inf])
@pytest.mark.parametrize("seed", range(4))
def test_no_stream_of_commands_brings_the_wire_beyond_its_limits(bend: float, seed: int) -> None:
    """The stream is the fastest that each tick lets through, with jumps and numbers that are none now and then."""
    rng = np.random.default_rng(seed)
    _, state, limits = joints(bend)
    written, kept = np.zeros((TICKS, 2)), np.zeros(TICKS, np.bool_)
    towards = np.ones(2)
    for tick in range(TICKS):
        towards = np.where(rng.random(2) < 0.02, -towards, towards)
        fastest = np.clip(state.written_rate[:2] + towards * min(bend, CHANGE), -CHANGE, CHANGE)
        state.position[:2] = -np.sign(fastest) * 10.0  # from which the command leads away
        state.actuators[:2] = state.written[:2] + fastest * (1.0 - 1e-9)
        if rng.random() < 0.02:
            state.actuators[rng.integers(2)] = rng.choice([np.nan, np.inf, 3.0, -0.5])
        kept[tick] = guard(state, limits)
        written[tick] = state.written[:2]
    assert np.abs(written).max() <= RANGE
    assert 0.1 < kept.mean() < 1.0
    changes = np.diff(written, axis=0)
    assert np.abs(changes).max() <= CHANGE * (1 + 1e-9)
    if bend < CHANGE:  # an end that is met within a tick is no end of a motion, but of a range
        assert np.abs(np.diff(changes, axis=0)).max() <= bend * (1 + 1e-9)


@pytest.mark.law
@pytest.mark.parametrize("bend", [0.0005, 0.0037])
@pytest.mark.parametrize("seed", range(4))
def test_when_no_command_is_safe_any_more_positions_come_to_rest_within_their_limits(bend: float, seed: int) -> None:
    """Also from commands that come nearer to where the joints are, wherever that is, which may bend as they like."""
    rng = np.random.default_rng(seed)
    states, state, limits = joints(bend)
    jumps = 0
    for tick in range(TICKS):
        if tick % 20 == 0:
            state.position[:2] = rng.uniform(-2.0 * RANGE, 2.0 * RANGE, 2)
        before = state.written_rate[:2].copy()
        change = np.clip(state.position[:2] - state.written[:2], -CHANGE, CHANGE)
        state.actuators[:2] = state.written[:2] + change * rng.choice([0.2, 1.0 - 1e-9])
        guard(state, limits)
        jumps += int((np.abs(state.written_rate[:2] - before) > bend).any())
        kept = states.copy()
        while state.written_rate.any():
            written, rate = state.written[:2].copy(), state.written_rate[:2].copy()
            state.actuators[:2] = np.nan
            assert not guard(state, limits)
            assert np.abs(state.written).max() <= RANGE
            assert np.abs(state.written[:2] - written - rate).max() <= bend * (1 + 1e-9)
        states[:] = kept
    assert jumps > 10


@pytest.mark.law
def test_wheels_brake_for_as_long_as_no_command_is_safe_whichever_part_gives_none() -> None:
    robot = turtlebot3_manipulation()
    wire, states, numbers = WireLimits.of(robot, HZ), new_states(1), np.zeros(1, LIMITS)
    numbers["joints"], numbers["is_drive"] = len(robot.joints), True
    for name in ("lower", "upper", "change", "bend"):
        put(numbers, name, getattr(wire, name)[None])
    [state], [limits] = kernels.as_objects(states), kernels.as_objects(numbers)
    drive, wheels = robot.need(Drive), slice(len(robot.joints) - 2, len(robot.joints))
    stop = drive.limits.stop_deceleration[0] / drive.wheel_radius / HZ
    for bad in range(len(robot.joints)):
        state.written[wheels] = before = np.array([0.9, -0.4]) * drive.max_wheel_speed
        for _ in range(HZ):
            state.actuators[:] = state.written
            state.actuators[bad] = np.nan
            assert not guard(state, limits)
            change = state.written[wheels] - before
            assert (np.abs(change) <= stop * 1.02).all()
            assert (change * before <= 0.0).all()
            before = state.written[wheels].copy()
        assert not before.any(), bad
