"""What the benchmarks share: spreads, rows with goals, options, exit statuses."""

import json
import time
from pathlib import Path

import pytest

from benchmarks._report import Report, parse_options
from benchmarks._turns import GOAL_MISSED, ratios, spread
from benchmarks.envs import BARE, OURS, TooLateError, summarise, time_limit
from tests.cases import each_case


def test_a_spread_is_the_median_between_the_ends() -> None:
    assert spread([3.0, 1.0, 10.0]) == {"median": 3.0, "low": 1.0, "high": 10.0, "turns": 3}
    assert ratios([2.0, 9.0], [1.0, 3.0]) == [2.0, 3.0]
    with pytest.raises(ValueError, match="zip"):
        ratios([1.0], [1.0, 2.0])


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


def test_what_did_not_come_up_is_listed_with_its_reason() -> None:
    speeds = {OURS: [70.0, 90.0], "SyncVectorEnv": [10.0, 10.0], BARE: [100.0, 100.0]}
    rows = summarise(speeds, {"AsyncVectorEnv": "it did not come up within 300 s"}, 64).rows
    assert [row.met for row in rows] == [None, True, None, None]
    assert [row.value for row in rows[1:]] == [
        "0.80 x (0.70 to 0.90)",
        "8.0 x (7.0 to 9.0)",
        "not measured: it did not come up within 300 s",
    ]
    assert summarise({**speeds, BARE: [200.0, 200.0]}, {}, 64).rows[1].met is False


def test_a_time_limit_ends_what_takes_too_long_and_nothing_else() -> None:
    with (
        pytest.raises(TooLateError, match=r"a long sleep did not come up within 0 s"),
        time_limit(0.05, "a long sleep"),
    ):
        time.sleep(60)
    with time_limit(60, "nothing"):
        pass


def test_options_have_the_types_of_their_defaults(capsys: pytest.CaptureFixture[str]) -> None:
    given = parse_options("Help.", ["--turns=3", "--quick"], turns=(7, "rounds"), quick=(False, ""), seconds=1.5)
    assert vars(given) == {"turns": 3, "quick": True, "seconds": 1.5, "json": None}
    with pytest.raises(SystemExit, match="2"):
        parse_options("Help.", ["--turns=many"], turns=7)
    assert "invalid int value" in capsys.readouterr().err
