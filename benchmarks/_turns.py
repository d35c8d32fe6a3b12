"""Measurements that take turns, in a few numbers: what the benchmarks share."""

import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any


def seconds(work: Callable[[], object]) -> float:
    """Return how long a call takes [s]."""
    started = time.perf_counter()
    work()
    return time.perf_counter() - started


def rates(works: Mapping[str, Callable[[], object]], count: int) -> dict[str, Callable[[], float]]:
    """Return what measures how many a second each of them does, for `in_turns`; a call of one does so many."""
    return {name: partial(_rate, work, count) for name, work in works.items()}


def _rate(work: Callable[[], object], count: int) -> float:
    return count / seconds(work)


def in_turns(parts: Mapping[str, Callable[[], float]], turns: int, *, uncounted: int = 1) -> dict[str, list[float]]:
    """Measure several things in turns, so that a noisy neighbour disturbs all of a turn.

    Args:
        parts: what measures each of them.
        turns: how often.
        uncounted: turns before those, whose values are dropped: what is loaded at first use belongs to none.

    Returns:
        The values of each, turn by turn.
    """
    values: dict[str, list[float]] = {name: [] for name in parts}
    for turn in range(-uncounted, turns):
        for name, part in parts.items():
            value = part()
            if turn >= 0:
                values[name].append(value)
    return values


def spread(values: Sequence[float]) -> dict[str, Any]:
    """Return the median of some measurements, the least and the largest of them, and how many there were."""
    return {"median": statistics.median(values), "low": min(values), "high": max(values), "turns": len(values)}


def ratios(ours: Sequence[float], theirs: Sequence[float]) -> list[float]:
    """Return ours over theirs, turn by turn: a noisy neighbour disturbs all of a turn."""
    return [mine / other for mine, other in zip(ours, theirs, strict=True)]


def shown(found: Mapping[str, float], form: str = ".2f") -> str:
    """Return a spread as text: the median, with the least and the largest in brackets."""
    return f"{found['median']:{form}} ({found['low']:{form}} to {found['high']:{form}})"


GOAL_MISSED = 3
"""Exit status of a benchmark that ran and missed a goal. After an exception it is 1; with wrong options, and where
nothing could be measured, 2."""


def status(*, met: bool) -> int:
    """Return the exit status of a benchmark that ran: 0, or `GOAL_MISSED`."""
    return 0 if met else GOAL_MISSED
