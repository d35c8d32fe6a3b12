"""One run: every case in turns, idle and under load, then the verdicts."""

import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field

from benchmarks.realtime.cases import Case, CaseError
from benchmarks.realtime.load import Load, cpu_load
from benchmarks.realtime.machine import CpuTimes
from benchmarks.realtime.statistics import Block, summarise

CONDITIONS = ("idle", "load")

# What a case needs beside its seconds: start, imports, warm-up. Only for the estimate and the load's upper limit.
OVERHEAD_S = 1.5

# What a loop at 1 kHz may use of two processors, start of its process included; what is beyond it is somebody else's.
_IDLE_BUSY = 0.15


@dataclass
class Run:
    """What was measured.

    Attributes:
        blocks: in the order in which they were measured.
        missing: name of each case that could not be measured, to the reason.
        load_shares: processor time that the load got in each of its turns, of all that the cores have.
    """

    blocks: list[Block] = field(default_factory=list)
    missing: dict[str, str] = field(default_factory=dict)
    load_shares: list[float] = field(default_factory=list)


def turns(cases: Sequence[str], conditions: Sequence[str], rounds: int) -> Iterator[tuple[int, str, tuple[str, ...]]]:
    """Yield round, condition and the order of the cases in it.

    Every other round goes backwards, so that a machine which becomes slower all the while favours nobody.
    """
    for number in range(rounds):
        order = tuple(cases) if number % 2 == 0 else tuple(reversed(cases))
        for condition in conditions:
            yield number, condition, order


def measure(
    cases: Sequence[Case],
    conditions: Sequence[str],
    rounds: int,
    seconds: float,
    *,
    progress: Callable[[str], None],
    load: Callable[[float], AbstractContextManager[Load]] = cpu_load,
) -> Run:
    """Measure all cases in turns.

    A case that fails is left out from then on, and the reason kept; the others go on. If the load fails, so does the
    run: numbers under a load that was none would be wrong.

    Args:
        cases: the loops.
        conditions: of `CONDITIONS`.
        rounds: blocks for each case and condition.
        seconds: length of a block [s].
        progress: is told what is going on.
        load: keeps the processors busy, for at most the seconds given.

    Raises:
        LoadError: the load did not start or ended early.
    """
    run = Run()
    by_name = {case.name: case for case in cases}
    total, done = rounds * len(conditions) * len(cases), 0
    for number, condition, order in turns(list(by_name), conditions, rounds):
        at_most = len(cases) * (60 + 4 * seconds)  # as long as all programs may take before they are given up
        loaded = load(at_most) if condition == "load" else nullcontext(None)
        with loaded as the_load:
            for name in order:
                done += 1
                if name in run.missing:
                    continue
                remaining = (total - done + 1) * (seconds + OVERHEAD_S)
                where = f"{done}/{total} round {number + 1}, {condition}, {by_name[name].title}"
                progress(f"{where}: {seconds:g} s; about {remaining / 60:.1f} min left")
                block = _block(by_name[name], seconds, condition, number, run)
                if block is None:
                    progress(f"LEFT OUT from now on: {by_name[name].title}: {run.missing[name]}")
                else:
                    progress(f"{where}: wake-up p50 {block.wake_p50:.1f} µs, p99 {block.wake_p99:.1f} µs")
        if the_load is not None and the_load.share is not None:
            run.load_shares.append(the_load.share)
    return run


def _block(case: Case, seconds: float, condition: str, number: int, run: Run) -> Block | None:
    before = CpuTimes.now()
    try:
        samples = case.run(seconds)
    except CaseError as error:
        run.missing[case.name] = str(error)
        return None
    block = summarise(samples, case.name, condition, number, CpuTimes.now().shares_since(before)[0])
    run.blocks.append(block)
    return block


def remarks(run: Run, titles: Mapping[str, str]) -> list[str]:
    """Return what a reader must know beside the tables: what the system refused, and how heavy the load was."""
    lines = [
        f"{titles.get(name, name)} was NOT MEASURED: {reason.rstrip('.')}!" for name, reason in run.missing.items()
    ]
    refused: dict[tuple[str, str], None] = {}
    for block in run.blocks:
        refused.update({(block.case, note): None for note in block.notes})
    lines += [f"{titles[case]}: the system refused {note}." for case, note in refused]
    # The smallest of a round: the negative control keeps a processor busy, and starting a process costs some, too.
    idle: dict[int, float] = {}
    for block in run.blocks:
        if block.condition == "idle" and block.busy is not None:
            idle[block.round] = min(block.busy, idle.get(block.round, 1.0))
    if idle:
        busiest = max(idle.values())
        lines.append(f"Idle, the processors were up to {busiest:.0%} busy with everything, the loops included.")
        if busiest > _IDLE_BUSY:
            lines.append("That is NOT IDLE: something else ran on this machine, and these numbers are disturbed!")
    if run.load_shares:
        low = min(run.load_shares)
        lines.append(f"The load got {low:.0%} of the processor time or more, beside the loops.")
        if low < 0.5:
            lines.append("That is LESS THAN HALF: something else ran on this machine, or the load is not one!")
    return lines


class Progress:
    """Shows that the benchmark lives: one line that changes on a terminal, one line an event elsewhere."""

    def __init__(self) -> None:
        self._terminal = sys.stderr.isatty()
        self._started = time.monotonic()

    def __call__(self, text: str) -> None:
        """Show a text."""
        elapsed = time.monotonic() - self._started
        line = f"[{int(elapsed) // 60}:{int(elapsed) % 60:02d}] {text}"
        if self._terminal and not text.startswith("LEFT OUT"):
            print(f"\r\x1b[K{line[:118]}", end="", file=sys.stderr, flush=True)
        else:
            print(("\r\x1b[K" if self._terminal else "") + line, file=sys.stderr, flush=True)

    def finish(self) -> None:
        """Leave the line."""
        if self._terminal:
            print("\r\x1b[K", end="", file=sys.stderr, flush=True)
