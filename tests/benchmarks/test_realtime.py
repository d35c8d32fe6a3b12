"""The arithmetic of `benchmarks.realtime`, on known series, and one run in its quickest form."""

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks._report import Report, Row
from benchmarks._turns import GOAL_MISSED
from benchmarks.realtime import (
    OURS,
    TWIN,
    VIDEO,
    NotMeasuredError,
    Ticks,
    main,
    summarise,
    summarise_blocks,
)

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


def block(loop: str, number: int, wake: float, share: float = 0.1) -> dict:
    times = {"wake_p50": wake, "wake_p99": 2 * wake, "wake_max": 3 * wake, "tick_p99": 100.0, "share": share}
    return {"robot": "ur5", "loop": loop, "condition": "quiet", "round": number, **times} | dict.fromkeys(
        ("ticks", "late", "missed"), 1
    )


def report(blocks: list[dict]) -> dict[str, Row]:
    found = Report("")
    summarise_blocks(found, blocks)
    return {row.what.removeprefix("ur5 at 1000 Hz, "): row for row in found.rows}


def test_ratios_are_of_neighbouring_blocks() -> None:
    noise = [1.0, 40.0, 1.0, 7.0, 1.0]  # a disturbance of both of a pair leaves their ratio alone
    blocks = [block(OURS, k, 12.0 * f) for k, f in enumerate(noise)]
    blocks += [block(TWIN, k, 10.0 * f) for k, f in enumerate(noise)] + [block(VIDEO, 0, 24.0)]
    rows = report(blocks)
    ours = rows[f"{OURS}, quiet, over {TWIN}"].value
    assert ours.startswith("wake_p50 12.0 us (1.20 x); ")
    assert "wake_max 1440.0 us" in ours
    assert rows[f"{OURS}, quiet: ticks"].value == "5, 5 late by over 0.1 ms, 5 missed"
    assert rows[f"{VIDEO}, quiet, over {OURS}"].value.startswith("wake_p50 24.0 us (2.00 x)")
    assert "x)" not in rows[f"{TWIN}, quiet"].value


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
