"""Which frames are out of tolerance, and when an episode is."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from bhd_lerobot.bodies.body import Rates
from bhd_lerobot.rollout.tolerance import FrameTiming, TimingTolerance, late_frames

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
def test_flags_are_set_where_a_limit_is_violated_and_nowhere_else(times, skipped, limits):
    lateness, age = times
    tolerance = TimingTolerance(max_lateness_s=limits[0], max_age_s=limits[1], max_skipped=limits[2])
    late = late_frames(FrameTiming(np.arange(30) * FRAME_S, age, lateness, skipped), tolerance, RATES)
    for k in range(30):
        over = lateness[k] > np.float32(limits[0]) or age[k] > np.float32(limits[1]) or skipped[k] > limits[2]
        assert late[k] == over
