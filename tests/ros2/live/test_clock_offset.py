"""When a message was measured, from stamps of another clock."""

import numpy as np
import pytest

from bhd_lerobot.ros2.live.clock_offset import ClockOffsets

SECOND = 1_000_000_000


@pytest.mark.parametrize("offset", [0, 1_795_000_000 * SECOND, -5 * SECOND])
@pytest.mark.parametrize("drift", [0.0, 50e-6])
def test_it_is_never_after_the_arrival_and_off_by_the_smallest_delay_at_most(offset: int, drift: float) -> None:
    rng = np.random.default_rng(0)
    clock = ClockOffsets(1)
    measured = np.arange(1, 500) * SECOND // 20 + 100 * SECOND
    delays = rng.exponential(0.02 * SECOND, len(measured)).astype(np.int64) + SECOND // 1000
    for number, (true, delay) in enumerate(zip(measured.tolist(), delays.tolist(), strict=True)):
        stamp = round(true * (1 + drift)) + offset
        found = clock.measured_ns(0, stamp, true + delay)
        assert found <= true + delay
        if number > 100:
            assert abs(found - true) < 4_000_000  # the smallest of a hundred delays, and 5 s of drift
    assert clock.jumps == [0]


def test_a_clock_that_is_set_begins_anew_and_stamps_of_zero_are_none() -> None:
    clock = ClockOffsets(1)
    for jump in (0, 3600, -7200, 0):
        for k in range(10):
            arrived = (1000 + k) * SECOND
            found = clock.measured_ns(0, arrived + jump * SECOND - SECOND // 100, arrived)
            assert 0 <= arrived - found < SECOND // 10
    assert clock.jumps == [3]
    assert clock.measured_ns(0, 0, 123) == 123


@pytest.mark.parametrize(
    ("are_one", "offset", "is_same"),
    [(True, 0, True), (True, 3600 * SECOND, False), (False, 0, False)],
    ids=["one clock", "not set yet", "several clocks"],
)
def test_topics_of_one_clock_share_the_smallest_delay(are_one: bool, offset: int, is_same: bool) -> None:
    """A scan that is stamped a turn before it is sent is a turn old."""
    clock, turn, delay = ClockOffsets(2, are_one=are_one), SECOND // 5, SECOND // 500
    for k in range(1, 50):
        now = (1000 + k) * turn
        clock.measured_ns(0, now - delay + 7 * SECOND, now)
        found = clock.measured_ns(1, now - turn - offset + 7 * SECOND, now)
    assert now - found == (turn - delay if is_same else 0)
    later = now + 10 * SECOND  # the other topic has fallen silent, and clocks drift
    assert clock.measured_ns(1, later - turn - offset + 7 * SECOND, later) == later
