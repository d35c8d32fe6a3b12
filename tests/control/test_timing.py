import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bhd_lerobot.control.timing import TimingStatistics

PERIOD = 5_000_000
BIN = 10 ** (1 / 20)  # 20 bins a decade


def collect(lateness: np.ndarray, duration: np.ndarray | int = 100) -> TimingStatistics:
    statistics = TimingStatistics(PERIOD)
    durations = np.broadcast_to(duration, lateness.shape)
    for k, (late, long) in enumerate(zip(lateness, durations, strict=True)):
        due = 10**15 + k * PERIOD
        statistics.add(due, due + int(late), due + int(late) + int(long))
    return statistics


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("scale", [3e3, 5e4, 2e6])
def test_quantiles_are_at_most_one_bin_too_high_and_never_too_low(seed: int, scale: float) -> None:
    lateness = np.random.default_rng(seed).lognormal(np.log(scale), 1.0, 997).astype(np.int64)
    summary = collect(lateness).summary()
    for share, measured in ((0.50, summary.lateness_p50), (0.99, summary.lateness_p99)):
        exact = np.quantile(lateness, share, method="inverted_cdf") / 1e9
        # Below a microsecond, the first bin, the statistics do not tell times apart.
        assert exact <= measured * (1 + 1e-12)
        assert measured <= max(exact * BIN * 1.001, 1e-6)
    assert summary.lateness_max == lateness.max() / 1e9


@given(st.lists(st.tuples(st.integers(-10_000, 20_000_000), st.integers(0, 20_000_000)), min_size=1, max_size=40))
def test_overruns_and_maxima_are_exact(ticks: list[tuple[int, int]]) -> None:
    late, long = np.array(ticks).T
    summary = collect(late, long).summary()
    assert summary.ticks == len(ticks)
    assert summary.overruns == int((late + long > PERIOD).sum())
    assert summary.lateness_max == max(0, late.max()) / 1e9
    assert summary.duration_max == long.max() / 1e9
    assert 0 <= summary.lateness_p50 <= summary.lateness_p99 <= summary.lateness_max


def test_a_punctual_loop_is_punctual() -> None:
    statistics = TimingStatistics(PERIOD)
    assert statistics.summary().ticks == 0
    assert statistics.summary().lateness_p99 == 0
    statistics.add_punctual(1000)
    summary = statistics.summary()
    assert (summary.ticks, summary.overruns) == (1000, 0)
    assert (summary.lateness_p50, summary.lateness_p99, summary.lateness_max) == (0, 0, 0)


def test_a_few_late_ticks_show_in_the_tail_only() -> None:
    statistics = collect(np.array([3_000_000] * 20))
    statistics.add_punctual(980)
    summary = statistics.summary()
    assert summary.lateness_p50 <= 1e-6
    assert summary.lateness_p99 == pytest.approx(0.003, rel=BIN - 1)


def test_lateness_beyond_the_last_bin_is_reported() -> None:
    summary = collect(np.array([60_000_000_000])).summary()
    assert summary.lateness_p50 == 60.0
