from dataclasses import asdict
from multiprocessing.shared_memory import SharedMemory

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bhd_lerobot.errors import ConfigError
from bhd_lerobot.realtime.timing import TimingStatistics, TimingSummary

PERIOD = 5_000_000
BIN = 10 ** (1 / 20)  # 20 bins a decade


def collect(lateness: np.ndarray, duration: np.ndarray | int = 100) -> TimingStatistics:
    statistics = TimingStatistics(PERIOD)
    durations = np.broadcast_to(duration, lateness.shape)
    for k, (late, long) in enumerate(zip(lateness, durations, strict=True)):
        due = 10**15 + k * PERIOD
        statistics.add(due, due + int(late), due + int(late) + int(long))
    return statistics


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
    nothing = asdict(statistics.summary())
    assert [nothing.pop(name) for name in ("period", "clock", "tolerated")] == [PERIOD / 1e9, "lockstep", {}]
    assert set(nothing.values()) == {0}
    statistics.add_punctual(1000)
    summary = statistics.summary()
    assert (summary.ticks, summary.overruns) == (1000, 0)
    assert (summary.lateness_p50, summary.lateness_p99, summary.lateness_max) == (0, 0, 0)


TICKS = st.lists(st.tuples(st.integers(0, PERIOD - 1), st.integers(0, 20_000_000), st.integers(0, 4)), max_size=40)


def on_grid(ticks: list[tuple[int, int, int]], first: int = 10**15, drift: float = 0.0) -> TimingStatistics:
    """Return the statistics of a loop that keeps to its grid, or is slower by a share: lateness, duration, skipped."""
    statistics = TimingStatistics(PERIOD)
    due = first
    for late, long, skipped in ticks:
        due += round((1 + skipped) * PERIOD * (1 + drift))
        statistics.add(due, due + late, due + late + long, skipped)
    return statistics


@given(TICKS)
def test_a_loop_on_its_grid_has_an_error_below_a_tick(ticks: list[tuple[int, int, int]]) -> None:
    summary = on_grid(ticks).summary()
    assert summary.ticks == len(ticks)
    assert summary.skipped == sum(skipped for *_, skipped in ticks)
    assert abs(summary.rate_error) < 1


def test_a_loop_that_drifts_has_an_error_that_grows() -> None:
    errors = [on_grid([(0, 100, 0)] * ticks, drift=0.01).summary().rate_error for ticks in (101, 1001)]
    assert errors == pytest.approx([-1, -10], rel=1e-6)


def test_ticks_that_are_neither_run_nor_counted_show_in_the_rate_error() -> None:
    statistics = TimingStatistics(PERIOD)
    for k in (0, 1, 2, 7, 8):
        statistics.add(k * PERIOD, k * PERIOD, k * PERIOD + 10)
    assert statistics.summary().rate_error == -4


@given(st.lists(st.integers(1, 10**11), min_size=1, max_size=60))
def test_quantiles_are_at_most_one_bin_too_high_and_never_too_low(times: list[int]) -> None:
    summary = collect(np.array(times), np.array(times)).summary()
    for share, name in ((0.50, "p50"), (0.99, "p99")):
        exact = np.quantile(times, share, method="inverted_cdf") / 1e9
        for measured in (getattr(summary, f"lateness_{name}"), getattr(summary, f"duration_{name}")):
            assert exact <= measured * (1 + 1e-12)
            if exact <= 10:  # Below a microsecond, the first bin, the statistics do not resolve times.
                assert measured <= max(exact * BIN * 1.001, 1e-6)
    assert summary.duration_p99 <= summary.duration_max == summary.lateness_max == max(times) / 1e9


def test_a_reader_sees_what_is_counted_and_changes_nothing() -> None:
    memory = SharedMemory(create=True, size=TimingStatistics.nbytes + 100)
    try:
        writer = TimingStatistics(PERIOD, memory.buf)
        writer.add(0, 7_000, 90_000, 2)
        content = bytes(memory.buf)
        reader = TimingStatistics.view(memory.buf)
        assert reader.period_ns == PERIOD
        assert reader.summary() == writer.summary()
        assert bytes(memory.buf) == content
        before = reader.copy()
        writer.add(PERIOD, PERIOD, PERIOD + 5)
        assert (reader.ticks, before.ticks) == (2, 1)
        writer.reset()
        assert reader.summary() == TimingStatistics(PERIOD).summary()
        writer.release()
        reader.release()
    finally:
        memory.close()  # raises if the buffer is still held
        memory.unlink()


@given(TICKS, TICKS)
def test_what_is_counted_since_a_copy_is_what_came_after_it(before, after):
    since, alone = on_grid([*before, *after]).since(on_grid(before)).summary(), on_grid(after).summary()
    for name in ("ticks", "overruns", "skipped"):
        assert getattr(since, name) == getattr(alone, name)
    for name in ("lateness_max", "duration_max", "lateness_p50", "duration_p99"):
        exact = getattr(alone, name)
        assert exact <= getattr(since, name) <= max(exact * BIN * 1.001, 1e-6)
    assert abs(since.rate_error) < 1


def test_a_used_buffer_is_cleared_for_a_new_loop() -> None:
    buffer = bytearray(b"\xff" * (TimingStatistics.nbytes + 8))
    assert TimingStatistics(PERIOD, buffer).summary() == TimingStatistics(PERIOD).summary()
    assert buffer[-8:] == b"\xff" * 8  # what lies behind is not ours


def test_memory_without_statistics_is_refused() -> None:
    with pytest.raises(ConfigError, match="holds no timing statistics"):
        TimingStatistics.view(bytearray(TimingStatistics.nbytes))
    for make in (TimingStatistics.view, lambda buffer: TimingStatistics(PERIOD, buffer)):
        with pytest.raises(ConfigError, match=f"{TimingStatistics.nbytes - 1} bytes"):
            make(bytearray(TimingStatistics.nbytes - 1))
    with pytest.raises(ConfigError, match="period_ns is 0"):
        TimingStatistics(0)


def test_summaries_of_other_versions_can_be_read() -> None:
    old = {"ticks": 200, "overruns": 0, "lateness_p50": 0.0, "lateness_p99": 0.0, "lateness_max": 0.0}
    old["duration_max"] = 0.0
    summary = TimingSummary.from_fields(old)
    assert (summary.ticks, summary.skipped, summary.late_frames, summary.clock) == (200, 0, 0, "lockstep")
    assert TimingSummary.from_fields({**old, "from_the_future": [1]}) == summary
    with pytest.raises(TypeError, match="ticks"):
        TimingSummary.from_fields({"overruns": 0})
