from typing import Any

import numpy as np
import pytest

from benchmarks.realtime.cases import CaseError
from benchmarks.realtime.injections import judge_plant_stop
from benchmarks.realtime.stamps import (
    StampError,
    block_samples,
    judge_loss,
    judge_stop,
    record_dtype,
    records_of,
    reference_speed,
)
from bhd_lerobot.control.messages import Mode
from bhd_lerobot.realtime.plant_link import PlantPhase, PlantShape

PERIOD = 1_000_000
START = 5_000_000_000
TICK_NS = 200_000


def states(ticks: list[int], late_ns: int = 20_000, width: int = 2) -> np.ndarray:
    """Published states of ticks of a grid that each start late and take the same time."""
    records = np.zeros(len(ticks), record_dtype(width))
    records["tick"], records["stretch"] = ticks, 3
    records["due_ns"] = START + records["tick"] * PERIOD
    records["start_ns"] = records["due_ns"] + late_ns
    records["ended_ns"][1:] = records["start_ns"][:-1] + TICK_NS
    records["executed"] = np.arange(1, len(ticks) + 1)
    records["skipped"] = records["tick"] + 1 - records["executed"]
    records["mode"] = Mode.TRACKING
    return records


# --- blocks ----------------------------------------------------------------------------------------------------------


def test_a_block_has_a_sample_for_each_tick_whose_end_is_known() -> None:
    samples = block_samples(states(list(range(100))), PERIOD, warm_up=10)
    assert samples.ticks == 89
    assert set(samples.wake_ns) == {20_000}
    assert set(samples.duration_ns) == {TICK_NS}
    assert samples.skipped == 0
    assert samples.count_error == pytest.approx(-0.02)


def test_skipped_ticks_are_counted_and_those_of_the_warm_up_are_not() -> None:
    ticks = [k for k in range(100) if k not in (5, 50, 51, 99)]
    samples = block_samples(states(ticks), PERIOD, warm_up=10)
    assert samples.skipped == 2
    assert samples.count_error == pytest.approx(-0.02)


def test_a_loop_that_counts_wrong_or_drifts_is_found_out() -> None:
    records = states(list(range(2000)))
    records["skipped"][1000:] += 2
    assert block_samples(records, PERIOD).count_error == pytest.approx(2 - 0.02)
    records = states(list(range(2000)))
    for name in ("due_ns", "start_ns", "ended_ns"):
        records[name] += np.arange(2000) * 10_000  # 1 % slow
    error = block_samples(records, PERIOD).count_error
    assert error is not None
    assert error < -19


def test_the_state_before_the_first_tick_is_no_tick() -> None:
    records = states(list(range(-1, 20)))
    records["executed"] -= 1
    records["skipped"] = 0
    assert block_samples(records, PERIOD).ticks == 19


@pytest.mark.parametrize(
    ("lose", "message"),
    [
        (lambda r: (r, 3), "3 states were overwritten"),
        (lambda r: (r[:0], 0), "no state"),
        (lambda r: (np.delete(r, 7), 0), "missing after tick 6"),
        (lambda r: (r[:11], 0), "only 1 ticks came after the 10"),
    ],
)
def test_an_incomplete_block_is_none(lose: Any, message: str) -> None:
    records, drops = lose(states(list(range(30))))
    with pytest.raises(StampError, match=message):
        block_samples(records, PERIOD, drops, warm_up=10)


def test_two_stretches_are_no_block() -> None:
    records = states(list(range(30)))
    records["stretch"][20:] = 4
    with pytest.raises(StampError, match="more than once"):
        block_samples(records, PERIOD)


def test_what_is_kept_of_a_state() -> None:
    published = np.zeros(
        2,
        [
            *((name, np.int64) for name in record_dtype(3).names or () if name not in ("mode", "command")),
            ("mode", np.int8, (1,)),
            ("command", np.float64, (1, 3)),
            ("physics", np.float64, (1, 40)),
        ],
    )
    published["tick"], published["mode"], published["command"] = [4, 5], [[3], [6]], [[[1, 2, 3]], [[4, 5, 6]]]
    records = records_of(published)
    assert records.dtype == record_dtype(3)
    assert records["tick"].tolist() == [4, 5]
    assert records["mode"].tolist() == [3, 6]
    assert records["command"].tolist() == [[1, 2, 3], [4, 5, 6]]


# --- emergency stops -------------------------------------------------------------------------------------------------


def stopping(first: int, speeds: list[float], n: int = 40) -> np.ndarray:
    """A base that moves at speed 1 and is latched at a tick; its speeds from then on."""
    records = states(list(range(n)))
    records["command"][:, 0] = 1.0
    records["mode"][first:] = Mode.ESTOP
    records["command"][first:, 0] = [*speeds, *[speeds[-1]] * (n - first - len(speeds))]
    return records


RAMP = [0.8, 0.6, 0.4, 0.2, 0.0]


@pytest.mark.parametrize(
    ("press_ns", "ticks"),
    [
        (START + 10 * PERIOD - 1, 1),  # before tick 10 is due: it is the next, and latches
        (START + 9 * PERIOD + 20_000 + TICK_NS, 1),  # at the very end of tick 9
        (START + 9 * PERIOD + 20_000 + TICK_NS - 1, 2),  # tick 9 runs
        (START + 8 * PERIOD + 500_000, 2),  # a whole tick went by
        (START + 7 * PERIOD + 500_000, 3),
    ],
)
def test_a_stop_is_counted_in_executed_ticks_from_the_press(press_ns: int, ticks: int) -> None:
    stop = judge_stop(stopping(10, RAMP), press_ns, commands_speeds=True)
    assert stop.ticks == ticks
    assert stop.stop_ms == pytest.approx((START + 14 * PERIOD + 20_000 - press_ns) / 1e6)
    assert not stop.why


def test_ticks_that_were_skipped_do_not_count() -> None:
    records = states([*range(9), *range(19, 50)])
    records["command"][:, 0] = 1.0
    records["mode"][9:], records["command"][9:, 0] = Mode.ESTOP, 0.0
    assert judge_stop(records, START + 9 * PERIOD, commands_speeds=True).ticks == 1


def test_a_stop_by_positions() -> None:
    records = stopping(10, RAMP)
    records["command"][:, 0] = np.cumsum(records["command"][:, 0])
    assert reference_speed(records, commands_speeds=False)[8:16] == pytest.approx([1, 1, *RAMP, 0])
    assert judge_stop(records, START + 10 * PERIOD - 1, commands_speeds=False).ticks == 1


def test_what_is_no_stop() -> None:
    press = START + 10 * PERIOD - 1
    never = judge_stop(stopping(10, RAMP)[:10], press, commands_speeds=True)
    assert (never.ticks, never.why) == (None, "the mode did not become ESTOP")
    faster = judge_stop(stopping(10, [0.8, 0.9, 0.5, 0.0]), press, commands_speeds=True)
    assert faster.ticks is None
    assert "faster 1 ticks into the stop" in faster.why
    goes_on = judge_stop(stopping(10, [0.8]), press, commands_speeds=True)
    assert goes_on.stop_ms is None
    assert "did not come to rest" in goes_on.why
    early = judge_stop(stopping(10, RAMP), START - PERIOD, commands_speeds=True)
    assert early.ticks is None
    assert "before the press" in early.why


# --- lost brains -----------------------------------------------------------------------------------------------------

TIMEOUT = 10 * PERIOD


def test_the_end_of_tracking_is_measured_against_the_last_sign_of_life() -> None:
    records = states(list(range(60)))
    records["mode"][25:] = Mode.STOPPING
    records["mode"][40:] = Mode.HOLD
    lost = START + 12 * PERIOD
    deadline = START + 24 * PERIOD + 300_000
    loss = judge_loss(records, lost, deadline, PERIOD, TIMEOUT)
    assert loss.error_ticks == pytest.approx(0.7)
    assert loss.hold_ms == pytest.approx(15.7)
    assert judge_loss(records, lost, deadline + 3 * PERIOD, PERIOD, TIMEOUT).error_ticks == pytest.approx(-2.3)


def test_the_end_of_tracking_is_measured_against_the_age_of_the_last_command() -> None:
    records = states(list(range(60)))
    due = START + 14 * PERIOD + 100_000  # of a command that came after the brain was lost: it was on its way
    records["command_age_ns"] = records["due_ns"] - due
    records["mode"][25:] = Mode.STOPPING
    loss = judge_loss(records, START + 12 * PERIOD, None, PERIOD, TIMEOUT)
    assert loss.error_ticks == pytest.approx(0.9)
    assert loss.hold_ms is None


def test_a_robot_that_goes_on_or_did_not_move_is_no_stop() -> None:
    records = states(list(range(60)))
    assert judge_loss(records, START, START + TIMEOUT, PERIOD, TIMEOUT).error_ticks is None
    records["mode"] = Mode.HOLD
    assert judge_loss(records, START, START + TIMEOUT, PERIOD, TIMEOUT).error_ticks is None


# --- plants ----------------------------------------------------------------------------------------------------------


def plant(stopped: int | None, command_ns: int) -> np.ndarray:
    made = np.zeros(40, PlantShape(2, 3, 3, 4, 1, 40).state_dtype)
    made["due_ns"] = START + np.arange(40) * PERIOD
    made["phase"], made["velocity"], made["command_ns"] = PlantPhase.DRIVEN, 0.2, command_ns
    if stopped is not None:
        made["phase"][stopped:] = PlantPhase.STOPPED
        made["velocity"][stopped + 3 :] = 0.001
    return made


def test_a_plant_is_judged_from_the_kill_or_the_last_command() -> None:
    killed = START + 2 * PERIOD
    stop = judge_plant_stop(plant(22, killed - 400_000), killed)
    assert (stop.stop_ms, stop.rest_ms) == (20.0, 23.0)
    stop = judge_plant_stop(plant(22, killed + 100_000), killed)
    assert stop.stop_ms == pytest.approx(19.9)


def test_a_plant_that_goes_on_is_an_error() -> None:
    with pytest.raises(CaseError, match="did not stop"):
        judge_plant_stop(plant(None, START), START)
