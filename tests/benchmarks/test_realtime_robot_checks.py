import math
from typing import Any

import pytest

from benchmarks.realtime.injections import Drops, Losses, PlantStop, Stops
from benchmarks.realtime.robot_checks import (
    Pair,
    drop_check,
    loss_checks,
    plant_check,
    ratio_checks,
    recording_checks,
    stop_checks,
)
from benchmarks.realtime.stamps import Loss, Stop
from benchmarks.realtime.statistics import Block


def block(case: str, number: int, wake_p99: float, tick_p99: float) -> Block:
    return Block(
        case=case,
        condition="idle",
        round=number,
        ticks=1000,
        skipped=0,
        late=0,
        wake_p50=10.0,
        wake_p99=wake_p99,
        wake_p999=wake_p99,
        wake_max=wake_p99,
        tick_p50=10.0,
        tick_p99=tick_p99,
        tick_max=tick_p99,
        period=1000.0,
        count_error=0.0,
    )


def test_both_percentiles_of_a_pair_are_compared_block_by_block() -> None:
    blocks = [block("a", k, 60.0 * (k + 1), 200.0) for k in range(3)]
    blocks += [block("b", k, 30.0 * (k + 1), 190.0) for k in range(3)]
    wake, tick = ratio_checks(Pair("a ÷ b", "a", "b", 1.5), blocks, ["idle"], {})
    assert (wake.measured, wake.verdict) == (2.0, "MISSED")
    assert (tick.measured, tick.verdict) == (pytest.approx(200 / 190), "met")


def test_a_pair_without_a_partner_names_the_reason_once() -> None:
    checks = ratio_checks(Pair("a ÷ b", "a", "b", 1.5), [], ["idle", "load"], {"a": "no torch", "b": "no torch"})
    assert len(checks) == 4
    assert {(check.verdict, check.reason) for check in checks} == {("not measured", "no torch")}


def report(case: str, **values: Any) -> dict[str, Any]:
    return {"case": case, "frames": 250, "drops": 0, "frames_due": 250, "count_error": -0.1} | values


def test_a_frame_that_is_neither_recorded_nor_counted_is_found() -> None:
    titles = {"a": "A", "b": "B", "c": "C"}
    reports = [report("a"), report("a", frames=248, drops=2), report("b", frames=249), report("b", count_error=1.5)]
    checks = {check.name: check for check in recording_checks(reports, titles, {"c": "it broke"})}
    frames = "|recorded + counted drops − frames due|"
    assert (checks[f"A: {frames}"].measured, checks[f"A: {frames}"].verdict) == (0, "met")
    assert "500 frames were due, 2 dropped" in checks[f"A: {frames}"].detail
    assert (checks[f"B: {frames}"].measured, checks[f"B: {frames}"].verdict) == (1, "MISSED")
    assert (checks[f"C: {frames}"].reason, checks[f"C: {frames}"].verdict) == ("it broke", "not measured")
    ticks = "|executed + skipped − rate × elapsed| [ticks]"
    assert (checks[f"A: {ticks}"].measured, checks[f"B: {ticks}"].measured) == (0.1, 1.5)
    assert checks[f"B: {ticks}"].verdict == "MISSED"


def test_a_frame_counted_twice_is_found_too() -> None:
    (_, frames) = recording_checks([report("a", frames=250, drops=1)], {"a": "A"}, {})
    assert frames.verdict == "MISSED"


def test_one_late_stop_of_many_is_a_miss_and_one_that_never_came_is_too() -> None:
    good = [Stop(1, 30.0)] * 499
    stops = {
        ("ur5", "idle"): Stops([*good, Stop(2, 35.0)], unsure=3),
        ("ur5", "load"): Stops([*good, Stop(3, 31.0)]),
        ("base", "idle"): Stops([*good, Stop(None, None, "the mode did not become ESTOP")]),
    }
    ok, late, never = stop_checks(stops, "")
    assert (ok.measured, ok.verdict) == (2, "met")
    assert ok.detail == (
        "500 stops; 499 within 1 tick; at rest after 35 ms at the most; 3 presses were interrupted and repeated"
    )
    assert (late.measured, late.verdict) == (3, "MISSED")
    assert (never.measured, never.verdict) == (math.inf, "MISSED")
    assert "did not become ESTOP" in never.detail


def test_stops_that_were_not_all_done_are_said_to_be_so() -> None:
    rows = stop_checks({("ur5", "idle"): Stops([Stop(1, 30.0)]), ("ur5", "load"): Stops()}, "the robot fell over")
    assert [row.verdict for row in rows] == ["met", "not measured"]
    assert rows[1].reason == "the robot fell over"


def test_losses_of_the_brain() -> None:
    losses = Losses(
        {
            ("SIGSTOP", "sign of life"): [Loss(0.9, 60.0), Loss(-0.4, 70.0)],
            ("SIGKILL", "sign of life"): [Loss(1.2, 60.0)],
            ("SIGSTOP", "command age"): [Loss(0.5, None)],
        },
        ended_s=[0.4],
    )
    rows = loss_checks(losses, "")
    assert [(row.measured, row.verdict) for row in rows] == [
        (0.9, "met"),
        (1.2, "MISSED"),
        (math.inf, "MISSED"),
        (0.0, "met"),
    ]
    assert "HOLD 70 ms after" in rows[0].detail
    assert not rows[3].reason
    left = loss_checks(Losses(left=["recorder (17)"], ended_s=[10.0]), "")[-1]
    assert (left.verdict, left.detail) == ("MISSED", "recorder (17)")
    assert loss_checks(Losses(), "")[-1].verdict == "not measured"
    assert loss_checks(None, "left out")[0].reason == "left out"


def test_drops_of_the_recorder() -> None:
    assert drop_check(Drops(1000, 800, 200), "").verdict == "met"
    assert drop_check(Drops(1000, 800, 199), "").verdict == "MISSED"
    assert drop_check(Drops(1000, 800, 201), "").verdict == "MISSED"
    nothing = drop_check(Drops(1000, 1000, 0), "")
    assert (nothing.verdict, "too shortly" in nothing.reason) == ("not measured", True)
    assert drop_check(Drops(1000, 999, 0), "").verdict == "MISSED"
    assert drop_check(None, "left out").reason == "left out"


def test_a_killed_cerebellum() -> None:
    assert plant_check([PlantStop(20.2, 23.0), PlantStop(20.9, 24.0)], "").measured == 20.9
    assert plant_check([PlantStop(21.1, 23.0)], "").verdict == "MISSED"
    assert plant_check([PlantStop(20.1, None)], "").verdict == "MISSED"
    assert plant_check(None, "left out").verdict == "not measured"
