"""What is taken for a measurement of the present: all that joints can do, and nothing that they cannot."""

from collections.abc import Callable
from typing import Any, Literal

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from bhd_lerobot.bodies.turtlebot3 import turtlebot3_burger
from bhd_lerobot.bodies.ur import ur5
from bhd_lerobot.control.kernels import as_objects
from bhd_lerobot.control.messages import NANOSECONDS, Mode
from bhd_lerobot.control.plant import PlantReading, SafetyStatus
from bhd_lerobot.control.reading_check import ReadingCheck, are_motions_wrong, are_positions_wrong
from bhd_lerobot.control.record import LIMITS, new_states

HZ = 500
PERIOD = NANOSECONDS // HZ
FASTEST = np.pi / HZ  # [rad] that a UR5's joint turns in a tick


class Check(ReadingCheck):
    """The check of n robots, and their reading."""

    def __init__(self, n: int = 1, body: Any = None, hz: int = HZ) -> None:
        self.states, self.numbers = new_states(n), np.zeros(1, LIMITS)
        super().__init__(ur5() if body is None else body, hz, self.states, self.numbers)
        self.reading = PlantReading(n, int(self.numbers["joints"][0]), 0, self.states)

    def wrong(self, now_ns: int, judge: Any = are_positions_wrong) -> list[bool]:
        """Return the robots whose reading, of a time, is no measurement."""
        self.states["stamp_ns"] = now_ns
        return [bool(judge(state, as_objects(self.numbers)[0])) for state in as_objects(self.states)]


@settings(max_examples=25)
@given(st.integers(0, 2**32 - 1), st.sampled_from([1, 2, 4]), st.integers(1, 3))
def test_whatever_joints_can_do_is_a_measurement(seed: int, every: int, n: int) -> None:
    """Joints that speed and reverse; a plant that is read more often than it measures; ticks that were skipped."""
    rng, check = np.random.default_rng(seed), Check(n)
    where, now, stamp = rng.uniform(-6, 6, (n, 7)), 0, 0
    for tick in range(200):
        ticks = int(rng.choice([1, 1, 1, 1, 2, 20]))
        now += ticks * PERIOD
        where[:, :6] += rng.choice([-1, 0, 1], (n, 6)) * FASTEST * ticks
        where[:, 6] = rng.uniform(0, 0.085)  # what a collision does to fingers
        if tick % every == 0:
            check.reading.position[:], stamp = where, now
        before = check.reading.position.copy()
        assert not any(check.wrong(stamp))
        np.testing.assert_array_equal(check.reading.position, before)
    assert not check.problem


@settings(max_examples=25)
@given(
    st.integers(0, 5),
    st.floats(0.12, 7.0) | st.floats(-7.0, -0.12) | st.sampled_from([np.nan, np.inf, -np.inf, 1e300]),
)
def test_a_jump_is_none_and_the_last_measurement_stays(joint: int, jump: float) -> None:
    check, where = Check(2), np.tile(np.array(ur5().arm.home), (2, 1))
    for tick in range(200):
        if tick < 10:
            where[0, joint] += FASTEST
        check.reading.position[:] = where
        check.reading.position[0, joint] += jump if tick >= 10 else 0.0
        assert check.wrong(tick * PERIOD) == [tick >= 10, False]
        np.testing.assert_array_equal(check.reading.position, where)
    if np.isfinite(jump) and abs(jump) < 100:
        assert check.problem.startswith(f"{ur5().joints[joint]} reads a change of {jump:.3f} rad within 2.0 ms")
    check.forget(np.arange(2))
    check.reading.position[:] = where + 1.0
    assert not any(check.wrong(200 * PERIOD))
    assert not check.problem


def test_a_fault_is_explained_until_its_own_robot_is_restarted() -> None:
    check = Check(2)
    check.reading.position[:] = ur5().arm.home
    assert check.wrong(0) == [False, False]
    check.reading.position[:] += 1.0
    assert check.wrong(PERIOD) == [True, True]
    for robot, is_explained in ((0, True), (1, False)):
        check.forget(np.array([robot]))
        assert bool(check.problem) == is_explained


def test_a_robot_in_a_stop_of_its_own_may_be_moved() -> None:
    check = Check()
    for tick, (safety, moved) in enumerate([(0, 0.0), (SafetyStatus.STOPPED, 0.5), (0, 0.0)]):
        check.reading.safety[0] = safety
        check.reading.position[0] += moved
        assert check.wrong(tick * PERIOD) == [False]


def test_wheels_have_no_end_and_no_jumps() -> None:
    check = Check(body=turtlebot3_burger(), hz=200)
    for tick in range(2000):
        check.reading.position += 6.7 / 200
        assert check.wrong(tick * NANOSECONDS // 200) == [False]
    check.reading.position[0, 1] = 0.0  # a counter that overflowed, or a board that was started anew
    assert check.wrong(10 * NANOSECONDS) == [True]


def moving(check: Check, spoil: Callable[[int], None], ticks: int = 300) -> int | None:
    """Sway an arm with torque motors, torques changing; return the tick in which its reading was refused, or None.

    Now and then ticks are skipped.
    """
    rng = np.random.default_rng(0)
    phase, check.states["mode"] = rng.uniform(0, 6, 6), Mode.TRACKING
    for tick in sorted({*range(0, ticks, 3), *rng.integers(0, ticks, ticks).tolist()} - set(range(40, 90))):
        time_s = tick / HZ
        check.reading.position[0, :6] = 0.4 * np.sin(2 * time_s + phase) + rng.normal(0, 1e-4, 6)
        check.reading.velocity[0, :6] = 0.8 * np.cos(2 * time_s + phase) + rng.normal(0, 5e-3, 6)
        spoil(tick)
        check.states["written"][0, :6] = np.sin(3 * time_s + phase) * 10.0
        if any(check.wrong(tick * PERIOD, are_motions_wrong)):
            return tick
    return None


def test_a_noisy_swaying_arm_is_no_contradiction_and_each_lie_about_its_motion_is_one_soon() -> None:
    begin = 100

    def run(spoil: Callable[[PlantReading], None], actuation: Literal["position", "torque"] = "torque") -> int | None:
        check = Check(body=ur5(actuation=actuation))
        if not check.numbers["is_torque"][0]:
            return None  # servos damp by themselves
        found = moving(check, lambda tick: spoil(check.reading) if tick >= begin else None)
        assert (found is not None) == bool(check.problem)
        return found

    held = np.full(6, 0.3)

    def wrong_sign(reading: PlantReading) -> None:
        reading.velocity[:, :6] *= -1.0

    def no_speed(reading: PlantReading) -> None:
        reading.velocity[:, :6] = 0.0

    def half_speed(reading: PlantReading) -> None:
        reading.velocity[:, :6] *= 0.5

    def frozen_joint(reading: PlantReading) -> None:
        reading.position[0, 2], reading.velocity[0, 2] = held[2], 0.0

    def frozen_position(reading: PlantReading) -> None:
        reading.position[0, 4] = held[4]

    assert run(lambda _: None) is None
    for lie in (wrong_sign, no_speed, half_speed, frozen_joint, frozen_position):
        found = run(lie)
        assert found is not None, lie
        assert begin <= found < begin + 75, lie
        assert run(lie, "position") is None
