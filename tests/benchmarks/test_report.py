"""What the benchmarks share: spreads, rows with goals, options, exit statuses."""

import json
import time
from pathlib import Path

import pytest

from benchmarks._report import Report
from benchmarks._turns import GOAL_MISSED
from benchmarks.envs import TooLateError, time_limit
from tests.cases import each_case


@each_case(("goal", "status"), [(None, 0), (2.5, 0), (2.6, GOAL_MISSED)])
def test_a_comparison_has_speeds_and_a_ratio_that_is_judged(goal: float | None, status: int, tmp_path: Path) -> None:
    report = Report("Speeds")
    report.compare("a thing", "samples/s", {"ours": [2000.0, 6000.0], "peer": [1000.0, 2000.0]}, ["peer"], goal=goal)
    assert report.end(tmp_path / "new" / "numbers.json") == status
    found = json.loads((tmp_path / "new" / "numbers.json").read_text(encoding="utf-8"))
    words, met = ("", None) if goal is None else (f"at least {goal} x", not status)
    assert found["rows"] == [
        {"what": "a thing: samples/s", "value": "ours 4,000.0, peer 1,500.0", "goal": "", "met": None},
        {"what": "a thing: ours / peer", "value": "2.5 x (2.0 to 3.0)", "goal": words, "met": met},
    ]
    assert found["a thing"]["peer"]["median"] == 1500.0


def test_a_time_limit_ends_what_takes_too_long_and_nothing_else() -> None:
    with (
        pytest.raises(TooLateError, match=r"a long sleep did not come up within 0 s"),
        time_limit(0.05, "a long sleep"),
    ):
        time.sleep(60)
    with time_limit(60, "nothing"):
        pass
