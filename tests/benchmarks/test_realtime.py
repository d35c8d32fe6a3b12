"""The arithmetic of `benchmarks.realtime`, on known series and a virtual clock, and one run in its quickest form."""

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks._turns import GOAL_MISSED
from benchmarks.realtime import (
    OURS,
    PYTHON,
    TWIN,
    VIDEO,
    NotMeasuredError,
    Ticks,
    main,
    missed_goals,
    rows,
    summarise,
    walk,
)
from tests.cases import each_case

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


@given(
    late=st.lists(st.integers(0, 5 * PERIOD), min_size=1, max_size=40),
    work=st.lists(st.integers(1, 5 * PERIOD), min_size=1, max_size=40),
)
def test_a_loop_keeps_the_phase_and_every_point_is_a_tick_or_missed(late: list[int], work: list[int]) -> None:
    clock, sleeps, ticks = [123], [0], [0]

    def sleep(seconds: float) -> None:
        clock[0] += round(seconds * 1e9) + late[sleeps[0] % len(late)]
        sleeps[0] += 1

    def tick() -> None:
        clock[0] += work[ticks[0] % len(work)]
        ticks[0] += 1

    times = walk(tick, PERIOD, 50, lambda: clock[0], sleep)
    due, started, ended = times.T
    assert len(times) == ticks[0]
    assert due[0] == 123 + PERIOD
    assert np.all(started >= due)
    assert np.all(due[1:] > ended[:-1] - PERIOD)  # what has passed is skipped
    found = summarise(Ticks(times, PERIOD), 0.0)
    assert found["ticks"] + found["missed"] == (due[-1] - due[0]) // PERIOD + 1 <= 50


def block(loop: str, number: int, wake: float, share: float = 0.1) -> dict:
    times = {"wake_p50": wake, "wake_p99": 2 * wake, "wake_max": 3 * wake, "tick_p99": 100.0, "share": share}
    return {"robot": "ur5", "loop": loop, "condition": "quiet", "round": number, **times} | dict.fromkeys(
        ("ticks", "late", "missed"), 1
    )


def test_ratios_are_of_neighbouring_blocks() -> None:
    noise = [1.0, 40.0, 1.0, 7.0, 1.0]  # a disturbance of both of a pair leaves their ratio alone
    blocks = [block(OURS, k, 12.0 * f) for k, f in enumerate(noise)]
    blocks += [block(TWIN, k, 10.0 * f) for k, f in enumerate(noise)] + [block(PYTHON, 9, 500.0)]
    blocks += [block(VIDEO, 0, 24.0)]
    by_loop = {row["loop"]: row for row in rows(blocks)}
    assert by_loop[OURS]["ratios"]["wake_p50"] == pytest.approx(1.2)
    assert (by_loop[OURS]["wake_p50"], by_loop[OURS]["wake_max"], by_loop[OURS]["ticks"]) == (12.0, 1440.0, 5)
    assert by_loop[VIDEO]["peer"] == OURS
    assert by_loop[VIDEO]["ratios"]["wake_p50"] == pytest.approx(2.0)
    assert by_loop[PYTHON]["ratios"]["wake_p50"] is None  # no twin's block in its round
    assert by_loop[TWIN]["peer"] == ""


def test_goals_are_judged_by_ratios_and_by_the_period() -> None:
    twin = [block(TWIN, 0, 10.0)]
    assert missed_goals(rows([block(OURS, 0, 11.9), *twin])) == []
    late, slow = (missed_goals(rows([one, *twin])) for one in (block(OURS, 0, 16.0), block(OURS, 0, 10.0, 0.3)))
    assert [one.split(": ")[1] for one in late] == [
        "wake_p50 ÷ C++ twin is 1.60, at most 1.2",
        "wake_p99 ÷ C++ twin is 1.60, at most 1.5",
    ]
    assert [one.split(": ")[1] for one in slow] == ["tick_p99 ÷ period is 0.30, at most 0.25"]


def test_a_loop_that_cannot_be_measured_is_left_out_with_the_reason_and_the_rest_is_measured(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("CXX", "no-such-compiler")
    out = tmp_path / "numbers.json"
    options = ["--quick", "--seconds=0.2", "--robots", "turtlebot3", "--conditions", "load", f"--json={out}"]
    assert main(options) in (0, GOAL_MISSED)  # the machine may be as busy as it likes
    found = json.loads(out.read_text(encoding="utf-8"))
    assert [row["loop"] for row in found["rows"]] == [PYTHON, OURS]
    assert [row["peer"] for row in found["rows"]] == ["", PYTHON]
    assert all(row["ticks"] + row["missed"] > 0 for row in found["rows"])
    shown = capsys.readouterr().out
    assert "C++ twin was NOT MEASURED: there is no C++ compiler (Debian and Ubuntu: package g++" in shown
    assert "not to be quoted" in shown


@each_case("option", ["--blocks=0", "--seconds=nan", "--robots=kuka"])
def test_options_that_make_no_sense_are_refused(option: str) -> None:
    with pytest.raises(SystemExit, match="2"):
        main([option])
