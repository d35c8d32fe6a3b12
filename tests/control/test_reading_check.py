"""What is taken for a measurement of the present: all that joints can do, and nothing that they cannot."""

from collections.abc import Callable
from typing import Literal

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bhd_lerobot.bodies.turtlebot3 import turtlebot3_burger
from bhd_lerobot.bodies.ur5 import ur5
from bhd_lerobot.control.messages import NANOSECONDS, Mode
from bhd_lerobot.control.plant import PlantReading, SafetyStatus
from bhd_lerobot.control.reading_check import ReadingCheck

HZ = 500
PERIOD = NANOSECONDS // HZ
FASTEST = np.pi / HZ  # [rad] that a UR5's joint turns in a tick


def made(n: int = 1, stamped: bool = False) -> tuple[ReadingCheck, PlantReading]:
    reading = PlantReading(n, 7)
    if stamped:
        reading.stamp_ns = np.zeros(n, np.int64)
    return ReadingCheck(ur5(), n, HZ), reading


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([1, 2, 4]), st.booleans(), st.integers(1, 3))
def test_whatever_joints_can_do_is_a_measurement(seed: int, every: int, stamped: bool, n: int) -> None:
    """Joints that speed and reverse; a plant that is read more often than it measures; ticks that were skipped."""
    rng = np.random.default_rng(seed)
    check, reading = made(n, stamped)
    where, now = rng.uniform(-6, 6, (n, 7)), 0
    for tick in range(200):
        ticks = int(rng.choice([1, 1, 1, 1, 2, 20]))
        now += ticks * PERIOD
        where[:, :6] += rng.choice([-1, 0, 1], (n, 6)) * FASTEST * ticks
        where[:, 6] = rng.uniform(0, 0.085)  # what a collision does to fingers
        if tick % every == 0 or not stamped:  # what has no stamps is of now
            reading.position[:] = where
            if reading.stamp_ns is not None:
                reading.stamp_ns[:] = now
        before = reading.position.copy()
        assert check.wrong_positions(reading, now) is None
        np.testing.assert_array_equal(reading.position, before)
    assert not check.problem


@settings(max_examples=60, deadline=None)
@given(
    st.integers(0, 5),
    st.floats(0.12, 7.0) | st.floats(-7.0, -0.12) | st.sampled_from([np.nan, np.inf, -np.inf, 1e300]),
    st.booleans(),
)
def test_a_jump_is_none_and_the_last_measurement_stays(joint: int, jump: float, stamped: bool) -> None:
    check, reading = made(2, stamped)
    where = np.tile(np.array(ur5().arm.home), (2, 1))
    for tick in range(10):
        where[0, joint] += FASTEST
        reading.position[:] = where
        if reading.stamp_ns is not None:
            reading.stamp_ns[:] = tick * PERIOD
        assert check.wrong_positions(reading, tick * PERIOD) is None
    for tick in range(10, 200):
        reading.position[:] = where
        reading.position[0, joint] += jump
        if reading.stamp_ns is not None:
            reading.stamp_ns[:] = tick * PERIOD
        wrong = check.wrong_positions(reading, tick * PERIOD)
        assert wrong is not None
        assert wrong.tolist() == [True, False]
        np.testing.assert_array_equal(reading.position, where)
    if np.isfinite(jump) and abs(jump) < 100:
        assert check.problem.startswith(f"{ur5().joints[joint]} reads a change of {jump:.3f} rad within 2.0 ms")
    check.forget(np.arange(2))
    reading.position[:] = where + 1.0
    assert check.wrong_positions(reading, 200 * PERIOD) is None
    assert not check.problem


def test_a_robot_in_a_stop_of_its_own_may_be_moved() -> None:
    check, reading = made()
    assert check.wrong_positions(reading, 0) is None
    reading.safety[0] = SafetyStatus.STOPPED
    reading.position[0] += 0.5
    assert check.wrong_positions(reading, PERIOD) is None
    reading.safety[0] = SafetyStatus.NORMAL
    assert check.wrong_positions(reading, 2 * PERIOD) is None


def test_wheels_have_no_end_and_no_jumps() -> None:
    check, reading = ReadingCheck(turtlebot3_burger(), 1, 200), PlantReading(1, 2)
    for tick in range(2000):
        reading.position += 6.7 / 200
        assert check.wrong_positions(reading, tick * NANOSECONDS // 200) is None
    reading.position[0, 1] = 0.0  # a counter that overflowed, or a board that was started anew
    assert check.wrong_positions(reading, 10 * NANOSECONDS) is not None


def moving(check: ReadingCheck, reading: PlantReading, spoil: Callable[[int], None], ticks: int = 300) -> int | None:
    """Sway an arm with torque motors, torques changing; return the tick in which its reading was refused, or None.

    Now and then ticks are skipped.
    """
    rng = np.random.default_rng(0)
    phase, mode = rng.uniform(0, 6, 6), np.array([Mode.TRACKING], np.int8)
    for tick in sorted({*range(0, ticks, 3), *rng.integers(0, ticks, ticks).tolist()} - set(range(40, 90))):
        time_s = tick / HZ
        reading.position[0, :6] = 0.4 * np.sin(2 * time_s + phase) + rng.normal(0, 1e-4, 6)
        reading.velocity[0, :6] = 0.8 * np.cos(2 * time_s + phase) + rng.normal(0, 5e-3, 6)
        if reading.stamp_ns is not None:
            reading.stamp_ns[0] = tick * PERIOD
        spoil(tick)
        torque = np.array([[*np.sin(3 * time_s + phase) * 10.0, 0.0]])
        if check.wrong_motions(reading, torque, mode, tick * PERIOD) is not None:
            return tick
    return None


@pytest.mark.parametrize("stamped", [False, True])
def test_a_noisy_swaying_arm_is_no_contradiction_and_each_lie_about_its_motion_is_one_soon(stamped: bool) -> None:
    begin = 100

    def run(spoil: Callable[[PlantReading], None], actuation: Literal["position", "torque"] = "torque") -> int | None:
        reading = PlantReading(1, 7)
        if stamped:
            reading.stamp_ns = np.zeros(1, np.int64)
        check = ReadingCheck(ur5(actuation=actuation), 1, HZ)
        found = moving(check, reading, lambda tick: spoil(reading) if tick >= begin else None)
        assert (found is not None) == bool(check.problem)
        return found

    held = np.full((2, 6), 0.3)

    def wrong_sign(reading: PlantReading) -> None:
        reading.velocity[:, :6] *= -1.0

    def no_speed(reading: PlantReading) -> None:
        reading.velocity[:, :6] = 0.0

    def half_speed(reading: PlantReading) -> None:
        reading.velocity[:, :6] *= 0.5

    def frozen_joint(reading: PlantReading) -> None:
        reading.values[:2, 0, 2] = held[:, 2] * (1.0, 0.0)

    def frozen_position(reading: PlantReading) -> None:
        reading.position[0, 4] = held[0, 4]

    assert run(lambda _: None) is None
    for lie in (wrong_sign, no_speed, half_speed, frozen_joint, frozen_position):
        found = run(lie)
        assert found is not None, lie
        assert begin <= found < begin + 75, lie
        assert run(lie, "position") is None  # servos damp by themselves
