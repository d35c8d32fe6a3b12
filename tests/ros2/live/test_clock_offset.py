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


def test_a_clock_that_is_set_begins_anew_and_stamps_of_zero_are_none() -> None:
    clock = ClockOffset()
    for jump in (0, 3600, -7200, 0):
        for k in range(10):
            arrived = (1000 + k) * SECOND
            found = clock.measured_ns(arrived + jump * SECOND - SECOND // 100, arrived)
            assert 0 <= arrived - found < SECOND // 10
    assert clock.measured_ns(0, 123) == 123


@pytest.mark.parametrize("rate", [0.1, 0.5, 0.8, 0.95, 1.0, 1.5])
@pytest.mark.parametrize("hz", [4, 20, 125])
def test_a_simulations_clock_has_its_own_rate_and_no_message_becomes_old_by_it(rate: float, hz: int) -> None:
    clock = ClockOffset()
    ages = []
    for number, real in enumerate(np.arange(0, 20, 1 / hz).tolist()):
        sent = 1_700_000_000 * SECOND + round(real * SECOND)
        arrived = 50 * SECOND + round((real + 0.001 * (number % 3)) * SECOND)
        ages.append((arrived - clock.measured_ns(100 * SECOND + round(rate * real * SECOND), arrived, sent)) / SECOND)
    assert min(ages) >= 0
    assert max(ages) < 0.26
    assert max(ages[-10:]) < 0.05
    assert clock.rate == pytest.approx(rate, rel=0.02)


def test_the_rate_of_a_simulation_may_change() -> None:
    clock, stamp = ClockOffset(), 100.0
    for real in np.arange(0, 40, 0.05).tolist():
        stamp += 0.05 * (1.0 if real % 10 < 5 else 0.4)
        arrived = round((50 + real) * SECOND)
        age = arrived - clock.measured_ns(round(stamp * SECOND), arrived, 1_700_000_000 * SECOND + round(real * SECOND))
        assert 0 <= age < 0.26 * SECOND


@pytest.mark.parametrize("latency", [0.0, 0.45, 0.8])
@pytest.mark.parametrize("network", [0.0, 0.1])
@pytest.mark.parametrize("is_synchronised", [True, False])
def test_on_the_senders_own_clock_the_age_is_that_of_the_stamp(latency, network, is_synchronised):
    """The way through the network is known where the clocks are the same; otherwise the least of it counts as none."""
    clock = ClockOffset(is_synchronised=is_synchronised)
    ahead = 0 if is_synchronised else -5000 * SECOND
    for real in np.arange(0, 5, 0.05).tolist():
        arrived = round((50 + real + network) * SECOND)
        wall = 1_700_000_000 * SECOND + round((real + network) * SECOND)
        sent = wall - round(network * SECOND) + ahead
        age = arrived - clock.measured_ns(sent - round(latency * SECOND), arrived, sent, wall)
        assert age == pytest.approx((latency + network * is_synchronised) * SECOND, abs=1000)


@pytest.mark.law
@pytest.mark.parametrize("step", [-5.0, -2.5, -0.5, 0.5, 3600.0])
@pytest.mark.parametrize("whose", ["stamps", "machine"])
def test_a_clock_that_is_set_makes_nothing_old(step: float, whose: str) -> None:
    clock = ClockOffset()
    for real in np.arange(0, 10, 0.05).tolist():
        arrived, sent = round((50 + real) * SECOND), 1_700_000_000 * SECOND + round(real * SECOND)
        change = round(step * SECOND) if real >= 5 else 0
        stamp, sent = sent + change, sent + change * (whose == "machine")
        age = arrived - clock.measured_ns(stamp - SECOND // 100, arrived, sent)
        assert 0 <= age < 0.3 * SECOND


def test_stamps_that_stand_still_are_none() -> None:
    clock = ClockOffset()
    assert [clock.measured_ns(5, at) for at in (100, 200, 300)][1:] == [200, 300]


@pytest.mark.parametrize("ahead_s", [0.0, 0.01, 5.0])
def test_a_stamp_that_is_far_ahead_of_its_sending_is_of_another_clock(ahead_s: float) -> None:
    clock = ClockOffset(is_synchronised=True)
    for number in range(1, 100):
        sent = (1000 + number) * SECOND // 20
        stamp = sent + round(ahead_s * SECOND)
        assert clock.measured_ns(stamp, sent, sent, sent) == sent
    sent += SECOND // 20
    late = clock.measured_ns(stamp + SECOND // 1000, sent, sent, sent)
    assert sent - late == pytest.approx((0.049 if ahead_s == 5 else 0.049 - ahead_s) * SECOND, abs=SECOND // 1000)
