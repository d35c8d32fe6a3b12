"""The arithmetic of `benchmarks.realtime`, on known series, and one run in its quickest form."""

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks._turns import GOAL_MISSED
from benchmarks.realtime import OURS, NotMeasuredError, Ticks, main, summarise

PERIOD = 1_000_000


def series(due: list[int], wake: int, tick: int) -> np.ndarray:
    start = np.array(due, np.int64) * PERIOD
    return np.stack((start, start + wake, start + wake + tick), axis=1)


def test_the_numbers_of_a_known_series() -> None:
    times = series(list(range(1000)), 0, 0)
    times[:, 1] += np.arange(1, 1001) * 1000  # late by 1 to 1000 µs
    times[:, 2] = times[:, 1] + 250_000
    found = summarise(Ticks(times, PERIOD), 0.0)
    assert found["wake_p50"] == pytest.approx(500.5)
    assert found["wake_p99"] == pytest.approx(np.percentile(np.arange(1, 1001), 99))
    assert (found["wake_max"], found["tick_p99"], found["share"]) == pytest.approx((1000.0, 250.0, 0.25))
    assert (found["ticks"], found["late"], found["missed"]) == (1000, 900, 0)


def test_points_without_a_tick_are_missed_and_the_warm_up_does_not_count() -> None:
    due = [k for k in range(1000) if k not in (5, 400, 401, 700)]
    found = summarise(Ticks(series(due, 30_000, 7_000), PERIOD), 0.3)
    assert (found["ticks"], found["missed"]) == (697, 3)


def test_a_missing_value_is_not_a_number() -> None:
    with pytest.raises(NotMeasuredError, match="no tick"):
        summarise(Ticks(series([0, 1], 0, 0), PERIOD), 0.3)
    with pytest.raises(NotMeasuredError, match="left its grid"):
        summarise(Ticks(series([0, 1, 1], 0, 0), PERIOD), 0.0)
    drifting = np.repeat(np.arange(10)[:, None] * (PERIOD + 7), 3, axis=1)  # anchored anew at every tick
    with pytest.raises(NotMeasuredError, match="left its grid"):
        summarise(Ticks(drifting, PERIOD), 0.0)


def test_a_loop_that_cannot_be_measured_is_left_out_with_the_reason_and_the_rest_is_measured(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("CXX", "no-such-compiler")
    out = tmp_path / "numbers.json"
    options = ["--quick", "--seconds=0.2", "--robots", "turtlebot3", "--conditions", "load", f"--json={out}"]
    assert main(options) in (0, GOAL_MISSED)  # the machine may be as busy as it likes
    found = json.loads(out.read_text(encoding="utf-8"))
    assert {one["loop"] for one in found["blocks"]} == {OURS}
    assert all(one["ticks"] + one["missed"] > 0 for one in found["blocks"])
    (note,) = (one for one in found["notes"] if "C++ twin" in one)
    assert "was NOT MEASURED: there is no C++ compiler (Debian and Ubuntu: package g++" in note
    assert "not to be quoted" in capsys.readouterr().out
