"""Which frames are out of tolerance, and when an episode is."""

from dataclasses import asdict, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from bhd_lerobot.bodies.body import Rates
from bhd_lerobot.control.timing import TimingStatistics, TimingSummary
from bhd_lerobot.control.tolerance import FrameTiming, TimingTolerance, late_frames, verdict
from bhd_lerobot.errors import ConfigError
from tests.cases import each_case

RATES = Rates(500, 500, 25)
PERIOD_S, FRAME_S = 1 / 500, 1 / 25


def punctual(frames: int) -> FrameTiming:
    zeros = np.zeros(frames, np.float32)
    return FrameTiming(1000.0 + np.arange(frames) * FRAME_S, zeros, zeros, np.zeros(frames, np.int64))


def changed(column: str, frame: int, value: float, frames: int = 10) -> FrameTiming:
    timing = punctual(frames)
    values = getattr(timing, column).copy()
    values[frame] = value
    return replace(timing, **{column: values})


@pytest.mark.parametrize("frames", [0, 1, 2, 50])
def test_a_punctual_episode_has_no_late_frame(frames: int) -> None:
    late = late_frames(punctual(frames), TimingTolerance(), RATES)
    assert late.dtype == np.bool_
    assert late.shape == (frames,)
    assert not late.any()


@pytest.mark.parametrize(
    ("column", "limit"),
    [("lateness", PERIOD_S / 2), ("age", FRAME_S), ("skipped", 0), ("lateness", float("inf")), ("age", float("nan"))],
)
def test_exactly_the_frame_beyond_a_default_is_late(column: str, limit: float) -> None:
    above = np.nextafter(np.float32(limit), np.float32(np.inf)) if column != "skipped" else 1
    if np.isfinite(limit):
        assert not late_frames(changed(column, 4, limit), TimingTolerance(), RATES).any()
    late = late_frames(changed(column, 4, above), TimingTolerance(), RATES)
    assert np.flatnonzero(late).tolist() == [4]


@pytest.mark.parametrize("limit", [1e-3, 0.0025, 1 / 3, 0.1])
def test_a_limit_does_not_turn_itself_away_in_single_precision(limit: float) -> None:
    tolerance = TimingTolerance(max_lateness_s=limit, max_age_s=limit)
    stored = np.full(5, limit, np.float32)
    frames = replace(punctual(5), lateness=stored, age=stored)
    assert not late_frames(frames, tolerance, RATES).any()


def test_a_slow_sensor_is_no_fault() -> None:
    frames = changed("age", 4, FRAME_S + 0.15)
    assert late_frames(frames, TimingTolerance(), RATES).any()
    assert not late_frames(frames, TimingTolerance(), RATES, sensor_period_s=0.2).any()


@pytest.mark.parametrize(("shift", "late"), [(0.49, []), (-0.49, []), (0.51, [6, 7]), (-0.51, [6, 7])])
def test_a_frame_out_of_place_is_late_and_so_is_the_one_after(shift: float, late: list[int]) -> None:
    """An observation that is half a frame off makes the interval before it long and the one after it short."""
    frames = changed("time", 6, 1000.0 + (6 + shift) * FRAME_S)
    assert np.flatnonzero(late_frames(frames, TimingTolerance(), RATES)).tolist() == late


@given(
    hnp.arrays(np.float32, (2, 30), elements=st.floats(0, 0.125, width=32)),
    hnp.arrays(np.int64, 30, elements=st.integers(0, 3)),
    st.tuples(st.floats(1e-4, 0.1), st.floats(1e-3, 0.1), st.integers(0, 3)),
)
def test_flags_are_set_where_a_limit_is_violated_and_nowhere_else(
    times: np.ndarray, skipped: np.ndarray, limits: tuple[float, float, int]
) -> None:
    lateness, age = times
    tolerance = TimingTolerance(max_lateness_s=limits[0], max_age_s=limits[1], max_skipped=limits[2])
    late = late_frames(FrameTiming(np.arange(30) * FRAME_S, age, lateness, skipped), tolerance, RATES)
    for k in range(30):
        over = lateness[k] > np.float32(limits[0]) or age[k] > np.float32(limits[1]) or skipped[k] > limits[2]
        assert late[k] == over


@each_case(
    ("values", "words"),
    [
        ({"max_lateness_s": 0.0}, "max_lateness_s is 0.0"),
        ({"max_lateness_s": float("nan")}, "max_lateness_s is nan"),
        ({"max_age_s": -1.0}, "max_age_s is -1.0"),
        ({"max_jitter_s": float("inf")}, "max_jitter_s is inf"),
        ({"max_skipped": -1}, "max_skipped is -1"),
        ({"max_late_frames": 1.5}, "max_late_frames is 1.5"),
        ({"max_late_frames": -0.1}, "max_late_frames is -0.1"),
    ],
)
def test_a_tolerance_that_cannot_be_honoured_is_refused(values: dict[str, float], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        TimingTolerance(**values)  # type: ignore[arg-type]


def summary(late: int, frames: int, **changes: float) -> TimingSummary:
    measured = TimingStatistics(2_000_000).summary(
        clock="realtime",
        late=np.arange(frames) < late,
        age=np.zeros(frames),
        tolerated=TimingTolerance().limits(RATES),
    )
    return replace(measured, **changes)


@each_case(
    ("share", "frames", "allowed"),
    [(0.01, 99, 0), (0.01, 100, 1), (0.29, 100, 29), (0.07, 100, 7), (0.0, 100, 0), (1.0, 100, 100), (0.5, 1, 0)],
)
def test_an_episode_is_bad_above_the_share_and_not_at_it(share: float, frames: int, allowed: int) -> None:
    tolerance = TimingTolerance(max_late_frames=share)
    assert verdict(summary(allowed, frames), tolerance) is None
    if allowed < frames:
        message = verdict(summary(allowed + 1, frames), tolerance)
        assert message is not None
        assert f"{allowed + 1} of {frames} frames" in message
        assert f"allows {allowed}" in message


def test_the_verdict_names_excess_and_remedy() -> None:
    late = "late by 12.30 ms (tolerated 1.00 ms); 14 control ticks were skipped. Give"
    for worst, words in (
        ({"lateness_max": 0.0123, "age_max": 0.002, "skipped": 14}, late),  # the age was not exceeded
        ({"age_max": 0.2}, "old by 200.00 ms (tolerated 40.00 ms)"),
        ({}, "uneven intervals"),
    ):
        message = verdict(summary(9, 100, **worst), TimingTolerance())
        assert message is not None
        assert words in message


def test_no_frames_and_no_wall_clock_are_never_bad() -> None:
    strict = TimingTolerance(max_late_frames=0.0)
    assert verdict(summary(0, 0), strict) is None
    assert verdict(replace(summary(5, 5), clock="lockstep"), strict) is None


def test_the_limits_are_recorded_as_they_were_resolved() -> None:
    limits = TimingTolerance(max_age_s=1).limits(RATES, sensor_period_s=0.2)
    assert limits == {"lateness": 0.001, "age": 1.0, "jitter": 0.02, "skipped": 0, "late_frames": 0.01}
    assert asdict(summary(1, 10))["tolerated"]["age"] == FRAME_S
