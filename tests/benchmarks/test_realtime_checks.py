import io
import math

import pytest
from rich.console import Console

from benchmarks.realtime.checks import Check, exit_status, loop_checks
from benchmarks.realtime.statistics import Block
from benchmarks.realtime.table import measured_table, verdict_table

# case -> wake-up p50 and p99 [µs], late ticks
SOUND = {
    "twin": (20.0, 40.0, 5),
    "ours": (22.0, 50.0, 6),
    "cyclictest": (15.0, 30.0, 4),
    "thread": (5000.0, 5200.0, 9000),
}
TITLES = {"twin": "C++ twin", "ours": "the loop", "cyclictest": "cyclictest", "thread": "thread"}


def blocks(
    values: dict[str, tuple[float, float, int]], *, tick_p99: float = 90.0, count_error: float = 0.2
) -> list[Block]:
    return [
        Block(
            case=case,
            condition=condition,
            round=number,
            ticks=9_999,
            skipped=0,
            late=late,
            wake_p50=p50,
            wake_p99=p99,
            wake_p999=p99,
            wake_max=p99,
            tick_p50=None if case == "cyclictest" else tick_p99 / 2,
            tick_p99=None if case == "cyclictest" else tick_p99,
            tick_max=None if case == "cyclictest" else tick_p99,
            period=1000.0,
            count_error=None if case == "cyclictest" else count_error,
        )
        for case, (p50, p99, late) in values.items()
        for condition in ("idle", "load")
        for number in range(6)
    ]


def judged(measured: list[Block], missing: dict[str, str] | None = None) -> list[Check]:
    return loop_checks(measured, ("idle", "load"), "ours", "the loop", missing or {})


def text(*tables: object) -> str:
    out = io.StringIO()
    console = Console(file=out, width=200)
    for table in tables:
        console.print(table)
    return out.getvalue()


@pytest.mark.parametrize(
    ("relation", "measured", "verdict"),
    [
        ("<=", 1.5, "met"),
        ("<=", 1.5000001, "MISSED"),
        ("<=", math.inf, "MISSED"),
        (">=", 1.5, "met"),
        (">=", 1.4, "MISSED"),
        ("<=", None, "not measured"),
        (">=", math.nan, "not measured"),
    ],
)
def test_a_verdict(relation: str, measured: float | None, verdict: str) -> None:
    assert Check("x", "idle", 1.5, relation, measured).verdict == verdict  # type: ignore[arg-type]


def test_a_sound_loop_meets_everything() -> None:
    checks = judged(blocks(SOUND))
    assert len(checks) == 12
    assert {check.verdict for check in checks} == {"met"}
    assert exit_status(checks) == 0


@pytest.mark.parametrize(
    ("changed", "tick_p99", "count_error", "name"),
    [
        ({"ours": (22.0, 61.0, 6)}, 90.0, 0.0, "wake-up p99"),
        ({"ours": (24.5, 50.0, 6)}, 90.0, 0.0, "wake-up p50"),
        ({"ours": (22.0, 50.0, 9)}, 90.0, 0.0, "late ticks"),
        ({"thread": (190.0, 200.0, 9)}, 90.0, 0.0, "negative control"),
        ({}, 251.0, 0.0, "whole tick"),
        ({}, 90.0, 1.2, "executed"),
        ({}, 90.0, -1.2, "executed"),
    ],
)
def test_each_fault_misses_its_own_bound(
    changed: dict[str, tuple[float, float, int]], tick_p99: float, count_error: float, name: str
) -> None:
    checks = judged(blocks(SOUND | changed, tick_p99=tick_p99, count_error=count_error))
    missed = [check for check in checks if check.verdict == "MISSED"]
    assert [check.condition for check in missed] == ["idle", "load"]
    assert all(name in check.name for check in missed)
    assert exit_status(checks) == 1


def test_without_the_twin_its_ratios_are_not_measured_and_the_reason_is_shown() -> None:
    without = {case: values for case, values in SOUND.items() if case != "twin"}
    checks = judged(blocks(without), {"twin": "no C++ compiler"})
    for check in checks:
        of_twin = "twin" in check.name
        assert check.verdict == ("not measured" if of_twin else "met")
        assert (check.reason == "no C++ compiler") == of_twin
    assert exit_status(checks) == 0
    assert text(verdict_table(checks)).count("no C++ compiler") == 6


def test_nothing_measured_is_never_met() -> None:
    checks = judged([])
    assert {check.verdict for check in checks} == {"not measured"}
    assert all(check.reason for check in checks)


def test_the_tables_show_every_case_and_every_verdict() -> None:
    measured = blocks(SOUND | {"ours": (22.0, 61.0, 6)})
    shown = text(measured_table(measured, TITLES), verdict_table(judged(measured)))
    for title in TITLES.values():
        assert title in shown
    assert shown.count("MISSED") == 2
    assert "1.52" in shown  # 61 / 40
    assert "59994" in shown  # the ticks of six blocks


def test_a_check_as_json_has_its_verdict() -> None:
    assert Check("x", "idle", 1.0, "<=", 2.0).as_json() == {
        "name": "x",
        "condition": "idle",
        "bound": 1.0,
        "relation": "<=",
        "measured": 2.0,
        "detail": "",
        "reason": "",
        "verdict": "MISSED",
    }
