"""What holds on the grid whatever the loop's delays are. Time is a number here."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bhd_lerobot.errors import ConfigError
from bhd_lerobot.realtime.grid import TickGrid

PERIOD = 1000
DELAYS = st.lists(st.tuples(st.integers(0, 3 * PERIOD), st.integers(0, 5 * PERIOD)), max_size=60)


@given(start=st.integers(-(10**15), 10**15), delays=DELAYS)
def test_executed_and_skipped_ticks_are_the_periods_that_passed(start: int, delays: list[tuple[int, int]]) -> None:
    grid, now = TickGrid(start, PERIOD), start
    last = -1
    for wake, work in delays:
        now = max(now, grid.next_due_ns) + wake
        slot = grid.begin(now)
        assert slot.due_ns == start + slot.index * PERIOD  # the phase never moves
        assert 0 <= slot.lateness_ns == now - slot.due_ns < PERIOD  # the newest tick that is due is the one that runs
        assert slot.index == last + 1 + slot.skipped
        assert grid.executed + grid.skipped == slot.index + 1 == (now - start) // PERIOD + 1
        last = slot.index
        now += work
        overruns = grid.overruns
        grid.end(now)
        assert grid.overruns - overruns == (now > grid.next_due_ns)


def test_a_clock_that_wakes_a_little_early_is_on_time() -> None:
    grid = TickGrid(0, PERIOD)
    assert grid.begin(-1).lateness_ns == 0
    assert grid.begin(PERIOD - 1).index == 1


def test_misses_in_a_row_are_counted_and_one_punctual_tick_forgives_them() -> None:
    grid = TickGrid(0, PERIOD, most_misses=3)
    for _ in range(2):
        grid.begin(grid.next_due_ns + PERIOD)
        assert not grid.too_many_misses
    grid.begin(grid.next_due_ns)
    for _ in range(2):
        grid.begin(grid.next_due_ns + PERIOD)
    assert not grid.too_many_misses
    grid.begin(grid.next_due_ns + 7 * PERIOD)
    assert grid.too_many_misses


@pytest.mark.parametrize(("period", "misses"), [(0, 1), (-5, 1), (10, 0)])
def test_impossible_grids_are_refused(period: int, misses: int) -> None:
    with pytest.raises(ConfigError, match="at least 1"):
        TickGrid(0, period, misses)
