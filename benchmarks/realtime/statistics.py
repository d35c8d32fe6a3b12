"""What a block of ticks says, and how two loops compare that took turns. Pure: no clock in here."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

# A tick that starts later than a tenth of the period of a 1 kHz loop. Far above what scheduling costs, far below what a
# robot notices, and rare enough on a sound system to tell a sound loop from one that is not.
LATE_NS = 100_000


@dataclass(frozen=True)
class Samples:
    """The ticks of one block.

    Attributes:
        wake_ns: how long after it was due each tick started [ns], shape (ticks,).
        duration_ns: how long each tick took [ns], shape (ticks,), or (0,) of a loop that does nothing in a tick.
        period_ns: the grid's period [ns].
        skipped: points of the grid that the loop reports as skipped.
        elapsed_ns: from when the first tick was due to the end of the last [ns]; None where it is not known.
        notes: what the system refused to the loop.
    """

    wake_ns: NDArray[np.int64]
    duration_ns: NDArray[np.int64]
    period_ns: int
    skipped: int
    elapsed_ns: int | None = None
    notes: tuple[str, ...] = ()

    @property
    def ticks(self) -> int:
        """How many ticks were executed."""
        return len(self.wake_ns)

    @property
    def count_error(self) -> float | None:
        """Executed + skipped − rate × elapsed time, in ticks.

        From 0 to 1 of a loop that keeps its rate and counts right, however late a tick is: the first point of the grid
        is at time 0, and what passes during the last tick is skipped.
        """
        if self.elapsed_ns is None:
            return None
        return self.ticks + self.skipped - self.elapsed_ns / self.period_ns

    @classmethod
    def from_records(
        cls, records: NDArray[np.int64], period_ns: int, skipped: int, notes: tuple[str, ...] = ()
    ) -> "Samples":
        """Make samples of when ticks were due, woke and ended.

        Args:
            records: due, woke and ended of each tick on one clock [ns], shape (ticks, 3).
            period_ns: the grid's period [ns].
            skipped: points of the grid that the loop reports as skipped.
            notes: what the system refused to the loop.
        """
        due, woke, ended = records.T
        elapsed = int(ended[-1] - due[0]) if len(due) else None
        return cls(woke - due, ended - woke, period_ns, skipped, elapsed, notes)


@dataclass(frozen=True)
class Block:
    """One case for some seconds under one condition: its numbers, times in microseconds.

    Attributes:
        case: name of the case.
        condition: ``"idle"`` or ``"load"``.
        round: the blocks of one round and condition are neighbours in time, and paired.
        ticks: ticks executed.
        skipped: points of the grid skipped.
        late: ticks that started more than `LATE_NS` after they were due.
        wake_p50: median wake-up latency.
        wake_p99: its 99th percentile.
        wake_p999: its 99.9th percentile.
        wake_max: the latest start.
        tick_p50: median duration of a tick, None of a loop that does nothing in a tick.
        tick_p99: its 99th percentile.
        tick_max: the longest tick.
        period: the grid's period.
        count_error: executed + skipped − rate × elapsed, in ticks; None where it is not known.
        notes: what the system refused to the loop.
        busy: share of the machine's processor time that was used meanwhile, by everybody; None where it is not known.
    """

    case: str
    condition: str
    round: int
    ticks: int
    skipped: int
    late: int
    wake_p50: float
    wake_p99: float
    wake_p999: float
    wake_max: float
    tick_p50: float | None
    tick_p99: float | None
    tick_max: float | None
    period: float
    count_error: float | None
    notes: tuple[str, ...] = ()
    busy: float | None = None

    def as_json(self) -> dict[str, Any]:
        """Return the block as a mapping that JSON can hold."""
        return asdict(self)


def summarise(samples: Samples, case: str, condition: str, round_: int, busy: float | None = None) -> Block:
    """Return the numbers of a block.

    Raises:
        ValueError: there are no samples, so that nothing can be said.
    """
    if samples.ticks == 0:
        raise ValueError(f"The block of {case!r} has no tick.")
    p50, p99, p999, latest = (float(v) / 1e3 for v in np.percentile(samples.wake_ns, (50, 99, 99.9, 100)))
    tick: tuple[float | None, ...] = (None, None, None)
    if len(samples.duration_ns):
        tick = tuple(float(v) / 1e3 for v in np.percentile(samples.duration_ns, (50, 99, 100)))
    return Block(
        case=case,
        condition=condition,
        round=round_,
        ticks=samples.ticks,
        skipped=samples.skipped,
        late=int(np.count_nonzero(samples.wake_ns > LATE_NS)),
        wake_p50=p50,
        wake_p99=p99,
        wake_p999=p999,
        wake_max=latest,
        tick_p50=tick[0],
        tick_p99=tick[1],
        tick_max=tick[2],
        period=samples.period_ns / 1e3,
        count_error=samples.count_error,
        notes=samples.notes,
        busy=busy,
    )


@dataclass(frozen=True)
class Spread:
    """The median of one value for each block, with the lowest and the highest of them."""

    median: float
    low: float
    high: float
    n: int

    @classmethod
    def of(cls, values: Sequence[float]) -> "Spread":
        """Return the spread of some values.

        Raises:
            ValueError: there are none.
        """
        if not len(values):
            raise ValueError("There are no values to take the median of.")
        return cls(float(np.median(values)), float(np.min(values)), float(np.max(values)), len(values))


def pairs(blocks: Sequence[Block], case: str, other: str, condition: str) -> list[tuple[Block, Block]]:
    """Return the blocks of two cases that were neighbours in time; a round that lacks one of them is left out."""
    of_other = {b.round: b for b in blocks if b.case == other and b.condition == condition}
    return [
        (b, of_other[b.round]) for b in blocks if b.case == case and b.condition == condition and b.round in of_other
    ]


def paired_ratio(blocks: Sequence[Block], case: str, other: str, condition: str, value: str) -> Spread | None:
    """Return the ratios of a value of two cases, block by block; None where no block has a partner.

    The median of the ratios, not the ratio of the medians: a noisy neighbour disturbs both of a pair.

    Args:
        blocks: all blocks of a run.
        case: the numerator.
        other: the denominator.
        condition: ``"idle"`` or ``"load"``.
        value: the attribute of `Block`, for example ``"wake_p99"``.
    """
    ratios = [_divide(getattr(a, value), getattr(b, value)) for a, b in pairs(blocks, case, other, condition)]
    return Spread.of(ratios) if ratios else None


def late_ratio(blocks: Sequence[Block], case: str, other: str, condition: str) -> Spread | None:
    """Return the ratios of the shares of late ticks, block by block; None where no block has a partner.

    One late tick is added on either side: where there are next to none, one more would otherwise be an infinite ratio.
    """
    ratios = [
        _divide((a.late + 1) / (a.ticks + 1), (b.late + 1) / (b.ticks + 1))
        for a, b in pairs(blocks, case, other, condition)
    ]
    return Spread.of(ratios) if ratios else None


def _divide(a: float, b: float) -> float:
    if b == 0:
        return 1.0 if a == 0 else float("inf")
    return a / b
