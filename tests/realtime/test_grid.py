"""The grid of ticks at its edges; what holds whatever the delays are: `test_loop`."""

import pytest

from bhd_lerobot.errors import ConfigError
from bhd_lerobot.realtime.grid import TickGrid

PERIOD = 1000


def test_a_clock_that_wakes_a_little_early_is_on_time() -> None:
    grid = TickGrid(0, PERIOD)
    assert grid.begin(-1).lateness_ns == 0
    assert grid.begin(PERIOD - 1).index == 1


@pytest.mark.parametrize(("period", "misses"), [(0, 1), (-5, 1), (10, 0)])
def test_impossible_grids_are_refused(period: int, misses: int) -> None:
    with pytest.raises(ConfigError, match="at least 1"):
        TickGrid(0, period, misses)
