"""From a target to wheel speeds and back to odometry, as the tick computes them for records of bases."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from bhd_lerobot.bodies.turtlebot3 import turtlebot3_burger
from bhd_lerobot.control.drive import BaseController, integrate, limit_command, turn_wheels, twist_from_wheels
from bhd_lerobot.control.kernels import as_objects
from bhd_lerobot.control.messages import Limit
from bhd_lerobot.control.plant import PlantReading
from tests.cases import each_case
from tests.control.support import wheel_speeds

DRIVE = turtlebot3_burger().drive
RADIUS, SEPARATION = 0.033, 0.160
# What one encoder count is worth, on the floor and in yaw.
COUNT_M = 2 * math.pi / 4096 * RADIUS
COUNT_RAD = COUNT_M / SEPARATION
HZ, N = 200, 5
PER_SPEED, PER_YAW = 1 / RADIUS, SEPARATION / 2 / RADIUS

ANY = st.floats(-1e6, 1e6) | st.floats(-3, 3) | st.sampled_from([0.0, -0.0, 0.22, 2.84, 1e300, -1e300])
NEAR = arrays(np.float64, (N, 2), elements=st.floats(-3, 3))
Array = np.ndarray


class Bases:
    """N bases without any limits but the ones that are given."""

    def __init__(self, n: int = N, **numbers: Any) -> None:
        self.controller = BaseController(DRIVE, n, HZ)
        free = dict.fromkeys(("velocity", "most_wheel_speed", "acceleration", "stop"), np.inf)
        for name, values in {**free, "jerk": 1e12, **numbers}.items():
            self.controller.numbers[name] = values
        self.states, self.command = self.controller.states, self.controller.command
        self._states, self._limits = as_objects(self.states), as_objects(self.controller.numbers)[0]

    def step(self, target: Array, *, hard: bool = False) -> tuple[Array, Array]:
        """Return the commands after a tick, and the flags that it raised."""
        self.states["target"], self.states["brakes_hard"], self.states["limits"] = target, hard, 0
        for state in self._states:
            limit_command(state, self._limits)
        return self.command.copy(), self.states["limits"].copy()

    def turn(self, angles: Array) -> Array:
        self.states["position"][:, :2] = angles
        for state in self._states:
            integrate(state, self._limits)
        return self.states["odometry"].copy()

    def start(self, ids: list[int], angles: Array) -> None:
        self.states["position"][ids, :2] = angles
        self.controller.configure(np.array(ids), PlantReading(len(self.states), 2, 0, self.states))


@given(target=arrays(np.float64, (N, 2), elements=ANY), velocity=arrays(np.float64, (2,), elements=st.floats(1e-3, 10)))
def test_the_velocity_limit_is_the_nearest_there_is_and_told_if_and_only_if_it_is_met(
    target: Array, velocity: Array
) -> None:
    bases = Bases(velocity=velocity)
    command, flags = bases.step(target, hard=True)
    np.testing.assert_array_equal(command, np.clip(target, -velocity, velocity))
    np.testing.assert_array_equal((flags & Limit.VELOCITY) != 0, (np.abs(target) > velocity).any(axis=1))
    again, flags = bases.step(command, hard=True)
    assert again.tobytes() == command.tobytes()
    assert not (flags & Limit.VELOCITY).any()


@pytest.mark.law
@given(twist=arrays(np.float64, (N, 2), elements=st.floats(-10, 10)))
def test_no_wheel_is_faster_than_its_limit_and_the_turn_is_kept(twist: Array) -> None:
    most = 6.9
    limited, flags = Bases(most_wheel_speed=most).step(twist, hard=True)
    np.testing.assert_array_equal(limited[:, 1], twist[:, 1])
    fastest = np.abs(limited[:, 0]) * PER_SPEED + np.abs(limited[:, 1]) * PER_YAW
    possible, changed = np.abs(twist[:, 1]) * PER_YAW <= most, limited[:, 0] != twist[:, 0]
    assert (fastest[possible] <= most * (1 + 1e-9)).all()
    assert (limited[~possible, 0] == 0).all()
    assert (np.abs(limited[:, 0]) <= np.abs(twist[:, 0])).all()
    assert (limited[:, 0] * twist[:, 0] >= 0).all()
    np.testing.assert_array_equal((flags & Limit.VELOCITY) != 0, changed)
    np.testing.assert_allclose(fastest[changed & possible], most, rtol=1e-9)  # no more is taken away than has to be


@pytest.mark.law
@given(target=NEAR, before=NEAR, stop=arrays(np.float64, (2,), elements=st.floats(0.05, 1)))
def test_a_hard_stop_changes_no_faster_and_arrives_exactly_after_the_ticks_that_it_takes(
    target: Array, before: Array, stop: Array
) -> None:
    bases = Bases(stop=stop)
    bases.command[:] = before
    out, flags = bases.step(target, hard=True)
    assert (np.abs(out - before) <= stop * (1 + 1e-12) + 1e-15).all()
    assert ((out - before) * (target - before) >= 0).all()  # towards what was asked for,
    assert (np.abs(out - before) <= np.abs(target - before) + 1e-15).all()  # and not past it
    held = np.abs(target - before) > stop
    np.testing.assert_array_equal(out[~held], target[~held])
    np.testing.assert_array_equal((flags & Limit.ACCELERATION) != 0, held.any(axis=1))
    for _ in range(int(np.ceil((np.abs(target - before) / stop).max()))):
        out, _ = bases.step(target, hard=True)
    assert out.tobytes() == target.tobytes()


@settings(max_examples=12)
@given(
    targets=arrays(np.float64, (6, N, 2), elements=st.sampled_from([-0.3, 0.0, 0.3]) | st.floats(-0.3, 0.3)),
    ticks=st.integers(1, 60),
    jerk=arrays(np.float64, (2,), elements=st.floats(1e-4, 1e-2)),
    largest=arrays(np.float64, (2,), elements=st.floats(1e-3, 0.05)),
)
def test_changes_change_gradually_and_arrive_without_overshoot(
    targets: Array, ticks: int, jerk: Array, largest: Array
) -> None:
    bases = Bases(jerk=jerk, acceleration=largest)
    seen = [bases.command.copy(), *(bases.step(target)[0] for target in targets for _ in range(ticks))]
    changes = np.diff([seen[0], *seen], axis=0)
    assert (np.abs(seen) <= 0.3 * (1 + 1e-9)).all()  # never past the farthest of all targets
    assert (np.abs(changes) <= largest * (1 + 1e-9) + 1e-12).all()
    assert (np.abs(np.diff(changes, axis=0)) <= jerk * (1 + 1e-9) + 2e-12).all()
    # What stays is reached exactly, in time, and not passed once it is approached.
    for _ in range(10 + int((0.7 / largest + 2 * largest / jerk + 3 * np.sqrt(0.7 / jerk)).max())):
        command, flags = bases.step(targets[-1])
    assert command.tobytes() == targets[-1].tobytes()
    assert not flags.any()
    assert not bases.states["rate"].any()
    bases, last = Bases(jerk=jerk, acceleration=largest), np.zeros((N, 2))
    for _ in range(200):
        command, flags = bases.step(targets[-1])
        np.testing.assert_array_equal(flags != 0, (np.abs(targets[-1] - last) > largest).any(axis=1))
        assert ((command - last) * np.sign(targets[-1]) >= 0).all()
        assert (np.abs(command) <= np.abs(targets[-1])).all()
        last = command


@settings(max_examples=30)
@given(targets=arrays(np.float64, (8, N, 2), elements=ANY), hard=st.lists(st.booleans(), min_size=8, max_size=8))
def test_on_the_way_between_two_commands_wheels_keep_their_limit_too(targets: Array, hard: list[bool]) -> None:
    bases = Bases(**{name: BaseController(DRIVE, 1, HZ).numbers[name] for name in ("most_wheel_speed", "jerk", "stop")})
    bases.controller.numbers["acceleration"] = np.array(DRIVE.limits.acceleration) / HZ
    for target, is_hard in zip(targets, hard, strict=True):
        for _ in range(20):
            command, _ = bases.step(target, hard=is_hard)
            fastest = np.abs(command[:, 0]) * PER_SPEED + np.abs(command[:, 1]) * PER_YAW
            possible = np.abs(command[:, 1]) * PER_YAW <= DRIVE.max_wheel_speed
            assert (fastest[possible] <= DRIVE.max_wheel_speed * (1 + 1e-9)).all()
            assert (command[~possible, 0] == 0).all()


def test_flags_accumulate_until_they_are_taken_and_what_is_no_number_is_rest() -> None:
    bases = Bases(velocity=1.0, acceleration=0.1, stop=0.1)
    for target, flag in ((np.nan, Limit.NON_FINITE), (-np.inf, Limit.NON_FINITE), (2.0, Limit.VELOCITY)):
        for k in range(2):
            row = np.zeros((N, 2))
            row[0, k] = target
            bases.states["target"] = row
            limit_command(bases._states[0], bases._limits)
            assert bases.states["limits"][0] & flag
            assert np.isfinite(bases.states["target"]).all()
    taken = bases.controller.take_limits()
    assert taken.tolist() == [int(Limit.NON_FINITE | Limit.VELOCITY | Limit.ACCELERATION), 0, 0, 0, 0]
    assert not bases.controller.take_limits().any()


# --- wheels and odometry ---------------------------------------------------------------------------------------------


def follow(speed: float, yaw_rate: float, seconds: float) -> Array:
    """Return the odometry of a base whose wheels turned by a twist."""
    bases, angles = Bases(1), np.array([(1234.5, -77.7)])
    bases.start([0], angles)
    rates = wheel_speeds(np.array([(speed, yaw_rate)]))
    return [bases.turn(angles + rates * tick / HZ) for tick in range(1, round(seconds * HZ) + 1)][-1][0]


@given(twist=arrays(np.float64, (N, 2), elements=st.floats(-3, 3)))
def test_twist_to_wheels_and_back(twist: Array) -> None:
    bases = Bases()
    bases.command[:] = twist
    for state in bases._states:
        turn_wheels(state, bases._limits)
    np.testing.assert_allclose(bases.controller.actuators, wheel_speeds(twist), atol=1e-12)
    np.testing.assert_allclose(twist_from_wheels(DRIVE, bases.controller.actuators), twist, atol=1e-12)


@each_case("turn", [0.2, -0.4])
def test_a_coarse_step_goes_along_the_chord_of_its_arc(turn: float) -> None:
    radius = 0.5
    wheels = np.array([radius - SEPARATION / 2, radius + SEPARATION / 2]) * abs(turn) / RADIUS
    x, y, yaw = Bases(1).turn(wheels if turn > 0 else wheels[::-1])[0]
    assert yaw == pytest.approx(turn, abs=2 * COUNT_RAD)
    assert math.atan2(y, x) == pytest.approx(turn / 2, abs=2 * COUNT_RAD)


@pytest.mark.law
@each_case(("speed", "rate"), [(0.2, -1.0), (-0.1, 0.7), (0.0, 2.84)])
def test_a_circle_closes(speed: float, rate: float) -> None:
    seconds = round(2 * math.pi / abs(rate) * HZ) / HZ
    exact = rate * seconds
    x, y, yaw = follow(speed, rate, seconds)
    assert yaw == pytest.approx(exact, abs=2 * COUNT_RAD)
    end = speed / rate * math.sin(exact), speed / rate * (1 - math.cos(exact))
    # The heading is off by up to a count all the way around a circle of this radius.
    assert math.hypot(x - end[0], y - end[1]) <= 2 * COUNT_M + 2 * math.pi * abs(speed / rate) * 2 * COUNT_RAD
    assert follow(speed, rate, seconds / 2)[1] == pytest.approx(2 * speed / rate, abs=0.003)


@given(st.lists(arrays(np.float64, (2, 2), elements=st.floats(-0.1, 0.1)), min_size=1, max_size=20))
def test_odometry_may_be_asked_for_between_two_ticks_and_each_base_has_its_own(steps: list[Array]) -> None:
    both, alone, angles = Bases(2), Bases(1), np.zeros((2, 2))
    for step in steps:
        angles = angles + step
        asked = both.controller.odometry_at(angles)
        assert asked.tobytes() == both.controller.odometry_at(angles).tobytes()  # asking changes nothing
        assert both.turn(angles).tobytes() == asked.tobytes()
        assert both.controller.odometry_at(angles).tobytes() == asked.tobytes()
        assert alone.turn(angles[1:]).tobytes() == asked[1:].tobytes()
    both.start([0], np.array([(1.0, 2.0)]))  # which does not touch the other
    angles[0] = 1.0, 2.0
    assert both.turn(angles).tolist() == [[0, 0, 0], asked[1].tolist()]


@given(st.lists(st.floats(-0.1, 0.1), min_size=1, max_size=50))
def test_quantisation_does_not_add_up(steps: list[float]) -> None:
    """However the wheels got there, the distance is that between the angles, to a count."""
    bases = Bases(1)
    for angle in np.cumsum(steps):
        x, _, yaw = bases.turn(np.full(2, angle))[0]
    assert x == pytest.approx(angle * RADIUS, abs=COUNT_M * 1.001)
    assert yaw == 0
