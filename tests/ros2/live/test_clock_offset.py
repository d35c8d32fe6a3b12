"""When a message was measured, from stamps of another clock."""

import numpy as np
import pytest

from bhd_lerobot.ros2.live.clock_offset import ClockOffset

SECOND = 1_000_000_000


@pytest.mark.parametrize("offset", [0, 1_795_000_000 * SECOND, -5 * SECOND])
@pytest.mark.parametrize("drift", [0.0, 50e-6])
def test_it_is_never_after_the_arrival_and_off_by_the_smallest_delay_at_most(offset: int, drift: float) -> None:
    rng = np.random.default_rng(0)
    clock = ClockOffset()
    measured = np.arange(1, 500) * SECOND // 20 + 100 * SECOND
    delays = rng.exponential(0.02 * SECOND, len(measured)).astype(np.int64) + SECOND // 1000
    for number, (true, delay) in enumerate(zip(measured.tolist(), delays.tolist(), strict=True)):
        stamp = round(true * (1 + drift)) + offset
        found = clock.measured_ns(stamp, true + delay)
        assert found <= true + delay
        if number > 100:
            assert abs(found - true) < 4_000_000  # the smallest of a hundred delays, and 5 s of drift
    assert clock.jumps == 0


def test_a_clock_that_is_set_begins_anew_and_stamps_of_zero_are_none() -> None:
    clock = ClockOffset()
    for jump in (0, 3600, -7200, 0):
        for k in range(10):
            arrived = (1000 + k) * SECOND
            found = clock.measured_ns(arrived + jump * SECOND - SECOND // 100, arrived)
            assert 0 <= arrived - found < SECOND // 10
    assert clock.jumps == 3
    assert clock.measured_ns(0, 123) == 123
