"""What the states that a robot publishes at every tick say about its loop. Pure: no clock and no process in here."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.realtime.statistics import Samples
from bhd_lerobot.control.messages import Mode

_NUMBERS = ("tick", "stretch", "due_ns", "start_ns", "ended_ns", "executed", "skipped", "command_age_ns")
Array = NDArray[Any]


def record_dtype(width: int) -> np.dtype:
    """Return the dtype of what is kept of a published state.

    ``ended_ns`` is when the tick before ended, as in the ring: when a tick ended is told by its successor.

    Args:
        width: values in a command.
    """
    numbers = [(name, np.int64) for name in _NUMBERS]
    return np.dtype([*numbers, ("mode", np.int8), ("command", np.float64, (width,))])


def records_of(states: Array) -> Array:
    """Return what is kept of published states of one robot, shape (states,)."""
    width = states.dtype["command"].shape[-1]
    records = np.zeros(len(states), record_dtype(width))
    for name in _NUMBERS:
        records[name] = states[name]
    records["mode"], records["command"] = states["mode"][:, 0], states["command"][:, 0]
    return records


class StampError(ValueError):
    """The states of a block are not those of one uninterrupted stretch of ticks."""


def check_complete(records: Array, drops: int) -> None:
    """Raise if states are missing.

    Raises:
        StampError: says what is missing.
    """
    if drops:
        raise StampError(f"{drops} states were overwritten before the benchmark could read them")
    if len(records) == 0:
        raise StampError("no state was published")
    if np.any(records["stretch"] != records["stretch"][0]):
        raise StampError("the loop was started more than once")
    lost = np.flatnonzero(np.diff(records["executed"]) != 1)
    if len(lost):
        raise StampError(f"a state is missing after tick {int(records['tick'][lost[0]])}")


def block_samples(
    records: Array, period_ns: int, drops: int = 0, warm_up: int = 0, notes: tuple[str, ...] = ()
) -> Samples:
    """Return the ticks of a stretch as samples; of the last tick nothing tells when it ended, so it is left out.

    The elapsed time runs from when the first tick was due to the start of the tick after the last: executed + skipped
    − rate × elapsed is then between −1 and 0 for a loop that keeps its rate, counts right, and skips what has passed.

    Args:
        records: the published states of a stretch in order, shape (states,).
        period_ns: the grid's period [ns].
        drops: states that the reader lost.
        warm_up: ticks at the beginning to leave out, as those of the other loops are.
        notes: what the system refused to the loop.

    Raises:
        StampError: a state is missing, or there are too few.
    """
    check_complete(records, drops)
    ticks = records[records["tick"] >= 0][warm_up:]
    if len(ticks) < 2:
        raise StampError(f"only {len(ticks)} ticks came after the {warm_up} of the warm-up")
    these, after = ticks[:-1], ticks[1:]
    return Samples(
        wake_ns=these["start_ns"] - these["due_ns"],
        duration_ns=after["ended_ns"] - these["start_ns"],
        period_ns=period_ns,
        skipped=int(after["skipped"][-1] - these["skipped"][0]),
        elapsed_ns=int(after["start_ns"][-1] - these["due_ns"][0]),
        notes=notes,
    )


def reference_speed(records: Array, *, commands_speeds: bool) -> NDArray[np.float64]:
    """Return how fast the reference moves, from one state to the next, shape (states,); 0 for the first.

    Args:
        records: the published states.
        commands_speeds: whether commands are speeds; otherwise they are positions, and the speed is what a command
            differs from the one before, for each period that has passed.
    """
    command = records["command"]
    if commands_speeds:
        return np.asarray(np.linalg.norm(command, axis=1))
    speed = np.zeros(len(records))
    if len(records) > 1:
        periods = np.maximum(np.diff(records["tick"]), 1)
        speed[1:] = np.linalg.norm(np.diff(command, axis=0), axis=1) / periods
    return speed


@dataclass(frozen=True)
class Stop:
    """What an emergency stop did.

    Attributes:
        ticks: executed ticks from the press to the first that commands the stop, the one that ran at the press
            included; None if the stop never came, or if the reference became faster in it.
        stop_ms: from the press to a reference at rest [ms]; None if it did not come to rest.
        why: what was wrong, in words.
    """

    ticks: int | None
    stop_ms: float | None
    why: str = ""


def judge_stop(records: Array, press_ns: int, *, commands_speeds: bool) -> Stop:
    """Return what became of an emergency stop.

    Args:
        records: published states from some ticks before the press to the end of the stop.
        press_ns: when the word was set, monotonic [ns].
        commands_speeds: whether commands are speeds, not positions.
    """
    # State k + 1 tells when tick k ended.
    done = np.flatnonzero(records["ended_ns"][1:] <= press_ns)
    if not len(done):
        return Stop(None, None, "no tick had ended before the press")
    last = int(done[-1])
    stopped = last + np.flatnonzero(records["mode"][last:] == Mode.ESTOP)
    if not len(stopped) or stopped[0] == 0:
        return Stop(None, None, "the mode did not become ESTOP")
    first = int(stopped[0])
    ticks = int(records["executed"][first] - records["executed"][last])
    speed = reference_speed(records, commands_speeds=commands_speeds)
    latched = records["mode"][first:] == Mode.ESTOP
    until = first + (int(np.argmin(latched)) if not latched.all() else len(latched))
    faster = np.flatnonzero(speed[first:until] > speed[first - 1 : until - 1] * (1 + 1e-6) + 1e-12)
    if len(faster):
        return Stop(None, None, f"the reference became faster {int(faster[0])} ticks into the stop")
    rest = np.flatnonzero(speed[first:until] < 1e-9)
    if not len(rest):
        return Stop(ticks, None, "the reference did not come to rest")
    return Stop(ticks, float(records["start_ns"][first + rest[0]] - press_ns) / 1e6)


@dataclass(frozen=True)
class Loss:
    """What a robot did when its brain was lost.

    Attributes:
        error_ticks: when TRACKING ended, on the grid, relative to when the time-out was over [ticks]; None if it did
            not end.
        hold_ms: from the end of the time-out to mode HOLD [ms]; None if it did not come to that.
    """

    error_ticks: float | None
    hold_ms: float | None


def judge_loss(records: Array, lost_ns: int, deadline_ns: int | None, period_ns: int, timeout_ns: int) -> Loss:
    """Return how a robot that was tracking came to HOLD.

    Args:
        records: published states, from before the brain was lost.
        lost_ns: when the brain was stopped or killed, monotonic [ns].
        deadline_ns: when the time-out was over, monotonic [ns]; None: it runs from when the last command was due.
        period_ns: the grid's period [ns].
        timeout_ns: the time-out, counted from that [ns].
    """
    after = records[records["start_ns"] >= lost_ns]
    ended = np.flatnonzero(after["mode"] != Mode.TRACKING)
    if not len(ended) or ended[0] == 0:
        return Loss(None, None)
    first = int(ended[0])
    if deadline_ns is None:
        last = after[first - 1]
        deadline_ns = int(last["due_ns"] - last["command_age_ns"]) + timeout_ns
    error = float(after["due_ns"][first] - deadline_ns) / period_ns
    held = np.flatnonzero(after["mode"][first:] == Mode.HOLD)
    hold = float(after["due_ns"][first + held[0]] - deadline_ns) / 1e6 if len(held) else None
    return Loss(error, hold)
