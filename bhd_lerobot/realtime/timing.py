"""How punctual a loop is: histograms that cost no memory, overruns, quantiles. Pure: no clock in here.

The numbers lie in one flat array of 64-bit integers, which may be shared memory: one process counts its ticks there and
others read, without a lock. Every number is written in one piece; a reader in the middle of a tick sees some
numbers with it and some without it, never a broken one.
"""

import math
from bisect import bisect_left
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bhd_lerobot.errors import ConfigError

Clock = Literal["lockstep", "realtime"]

# Logarithmic bins, 20 a decade from 1 us to 10 s: a quantile read from them is at most 12 % too high.
_EDGES_NS: list[int] = np.round(1_000 * 10 ** (np.arange(141) / 20)).astype(int).tolist()
_BINS = len(_EDGES_NS) + 1

# Layout of the array.
_TICKS, _OVERRUNS, _SKIPPED, _INTERVALS, _ELAPSED = range(5)
_LATENESS = 5
_DURATION = _LATENESS + _BINS
_LATEST = _DURATION + _BINS
_LONGEST, _LAST_START, _PERIOD, _FORMAT, _CELLS = range(_LATEST + 1, _LATEST + 6)
_FORMAT_1 = 0x7469_6D69_6E67_0001  # the last cell: version of this layout


@dataclass(frozen=True)
class TimingSummary:
    """What happened on a loop, times in seconds. On a simulated clock nothing is late and nothing takes time.

    Attributes:
        ticks: number of ticks that were run.
        overruns: ticks that ended after their successor was due.
        lateness_p50: half the ticks started no later after they were due.
        lateness_p99: 99 % of the ticks started no later after they were due.
        lateness_max: the latest start.
        duration_max: the longest tick.
        duration_p50: half the ticks took no longer.
        duration_p99: 99 % of the ticks took no longer.
        skipped: ticks that were left out because one before them was late.
        rate_error: executed + skipped - rate x elapsed, in ticks: for a loop that keeps to its grid no more than the
            lateness of its first and last tick.
        elapsed: time from the start of the first to the start of the last tick.
        period: the loop's period.
        frames: frames of the episode.
        late_frames: how many of them violate the timing tolerance.
        drops: frames or states that were lost, and counted.
        age_max: the largest age of an observation when the brain got it.
        inference_p50: half the frames were driven by a decision that took no longer.
        inference_p99: 99 % of the frames were driven by a decision that took no longer.
        inference_max: the longest decision.
        clock: whose time it is: `lockstep` (simulated) or `realtime`.
        tolerated: the limits by which frames were judged: `lateness`, `age`, `jitter` [s], `skipped` [ticks] and
            `late_frames` [share]; empty if they were not.
    """

    ticks: int
    overruns: int
    lateness_p50: float
    lateness_p99: float
    lateness_max: float
    duration_max: float
    duration_p50: float = 0.0
    duration_p99: float = 0.0
    skipped: int = 0
    rate_error: float = 0.0
    elapsed: float = 0.0
    period: float = 0.0
    frames: int = 0
    late_frames: int = 0
    drops: int = 0
    age_max: float = 0.0
    inference_p50: float = 0.0
    inference_p99: float = 0.0
    inference_max: float = 0.0
    clock: Clock = "lockstep"
    tolerated: dict[str, float] = field(default_factory=dict)

    @classmethod
    def from_fields(cls, values: Mapping[str, Any]) -> Self:
        """Return the summary that was stored as plain values.

        What a version before this did not store reads as 0, which is true of it: it knew the simulated clock only. What
        a later version stored in addition is left out.

        Raises:
            TypeError: a value without which there is no summary is missing.
        """
        return cls(**{own.name: values[own.name] for own in fields(cls) if own.name in values})


class TimingStatistics:
    """Collects start and end of every tick of a periodic loop. One writer, any number of readers.

    Args:
        period_ns: the loop's period [ns].
        buffer: where the numbers are kept, at least `nbytes` long, for example shared memory; cleared first. Memory of
            its own if None.

    Raises:
        ConfigError: the period is not positive, or the buffer is too short.
    """

    nbytes: ClassVar[int] = 8 * _CELLS
    """Size of the array in memory [bytes]."""

    def __init__(self, period_ns: int, buffer: Any = None) -> None:
        if period_ns < 1:
            raise ConfigError(f"period_ns is {period_ns}; it must be at least 1.")
        self._cells = _cells_of(bytearray(self.nbytes) if buffer is None else buffer)
        self.period_ns = period_ns
        self.reset()

    @classmethod
    def view(cls, buffer: Any) -> Self:
        """Return the statistics that lie in a buffer, where another process may be counting; nothing is changed.

        Raises:
            ConfigError: there are none in it.
        """
        statistics = cls.__new__(cls)
        statistics._cells = _cells_of(buffer)
        statistics.period_ns = statistics._cells[_PERIOD]
        if statistics._cells[_FORMAT] != _FORMAT_1 or statistics.period_ns < 1:
            statistics.release()
            raise ConfigError(
                "The buffer holds no timing statistics of this version. Attach after the process that counts has "
                "started, and run the same version of bhd_lerobot on both sides."
            )
        return statistics

    def release(self) -> None:
        """Let go of the buffer, so that shared memory can be closed; the statistics cannot be used afterwards."""
        self._cells.release()

    def reset(self) -> None:
        """Forget all ticks. For the writer only."""
        self._cells[_FORMAT] = 0
        self._cells[:] = memoryview(bytearray(self.nbytes)).cast("q")
        self._cells[_PERIOD] = self.period_ns
        self._cells[_FORMAT] = _FORMAT_1

    def add(self, due_ns: int, start_ns: int, end_ns: int, skipped: int = 0) -> None:
        """Count one tick.

        Args:
            due_ns: when it was due [ns].
            start_ns: when it started [ns].
            end_ns: when it ended [ns].
            skipped: ticks of the grid that were left out between the tick before and this one.
        """
        cells = self._cells
        lateness = max(0, start_ns - due_ns)
        duration = end_ns - start_ns
        cells[_LATENESS + bisect_left(_EDGES_NS, lateness)] += 1
        cells[_DURATION + bisect_left(_EDGES_NS, duration)] += 1
        cells[_LATEST] = max(cells[_LATEST], lateness)
        cells[_LONGEST] = max(cells[_LONGEST], duration)
        if end_ns > due_ns + self.period_ns:
            cells[_OVERRUNS] += 1
        if skipped:
            cells[_SKIPPED] += skipped
        if cells[_TICKS]:
            cells[_INTERVALS] += 1 + skipped
            cells[_ELAPSED] += start_ns - cells[_LAST_START]
        cells[_LAST_START] = start_ns
        cells[_TICKS] += 1

    def add_punctual(self, ticks: int) -> None:
        """Count ticks of a simulated clock, which are on time and take no time by construction."""
        cells = self._cells
        cells[_LATENESS] += ticks
        cells[_DURATION] += ticks
        cells[_TICKS] += ticks
        cells[_INTERVALS] += ticks
        cells[_ELAPSED] += ticks * self.period_ns

    def copy(self) -> "TimingStatistics":
        """Return a copy in memory of its own."""
        copied = TimingStatistics(self.period_ns)
        copied._cells[:] = self._cells
        return copied

    def since(self, before: "TimingStatistics") -> "TimingStatistics":
        """Return what was counted after a copy was made. Its maxima are at most 12 % too high, as quantiles are."""
        counted = self.copy()
        cells, earlier = counted._array(), before._array()
        cells[:_LAST_START] -= np.where(np.isin(np.arange(_LAST_START), (_LATEST, _LONGEST)), 0, earlier[:_LAST_START])
        for first, end, largest in ((_LATENESS, _DURATION, _LATEST), (_DURATION, _LATEST, _LONGEST)):
            cells[largest] = round(_quantile(cells[first:end], 1.0, cells[largest]) * 1e9)
        return counted

    @property
    def ticks(self) -> int:
        """Ticks so far."""
        return self._cells[_TICKS]

    @property
    def histograms(self) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]:
        """Upper edges of the bins [s], the last one infinite; ticks by lateness; ticks by duration; each (142,)."""
        cells = self._array().copy()
        edges = np.append(np.array(_EDGES_NS) / 1e9, np.inf)
        return edges, cells[_LATENESS:_DURATION], cells[_DURATION:_LATEST]

    def summary(
        self,
        *,
        clock: Clock = "lockstep",
        age: ArrayLike = (),
        inference_time: ArrayLike = (),
        late: ArrayLike = (),
        drops: int = 0,
        tolerated: Mapping[str, float] | None = None,
    ) -> TimingSummary:
        """Return what happened so far, together with what is known of an episode's frames.

        Args:
            clock: whose time it is.
            age: age of the observation of every frame [s], shape (frames,).
            inference_time: time that the brain took for the decision that drove every frame [s], shape (frames,).
            late: whether a frame violates the tolerance, shape (frames,).
            drops: frames or states that were lost, and counted.
            tolerated: the limits by which `late` was judged.
        """
        cells = self._array().copy()
        ages, inference, lates = np.asarray(age, float), np.asarray(inference_time, float), np.asarray(late, bool)
        return TimingSummary(
            ticks=int(cells[_TICKS]),
            overruns=int(cells[_OVERRUNS]),
            lateness_p50=_quantile(cells[_LATENESS:_DURATION], 0.50, cells[_LATEST]),
            lateness_p99=_quantile(cells[_LATENESS:_DURATION], 0.99, cells[_LATEST]),
            lateness_max=int(cells[_LATEST]) / 1e9,
            duration_max=int(cells[_LONGEST]) / 1e9,
            duration_p50=_quantile(cells[_DURATION:_LATEST], 0.50, cells[_LONGEST]),
            duration_p99=_quantile(cells[_DURATION:_LATEST], 0.99, cells[_LONGEST]),
            skipped=int(cells[_SKIPPED]),
            rate_error=float(cells[_INTERVALS] - cells[_ELAPSED] / self.period_ns),
            elapsed=int(cells[_ELAPSED]) / 1e9,
            period=self.period_ns / 1e9,
            frames=max(ages.size, inference.size, lates.size),
            late_frames=int(lates.sum()),
            drops=drops,
            age_max=float(ages.max(initial=0.0)),
            inference_p50=_exact_quantile(inference, 0.50),
            inference_p99=_exact_quantile(inference, 0.99),
            inference_max=float(inference.max(initial=0.0)),
            clock=clock,
            tolerated=dict(tolerated or {}),
        )

    def _array(self) -> NDArray[np.int64]:
        return np.frombuffer(self._cells, np.int64)


def _cells_of(buffer: Any) -> memoryview:
    """Return the beginning of a buffer as 64-bit integers. Single ones are read and written faster so than by numpy."""
    raw = memoryview(buffer).cast("B")
    if len(raw) < TimingStatistics.nbytes:
        raise ConfigError(f"The buffer has {len(raw)} bytes; timing statistics need {TimingStatistics.nbytes}.")
    return raw[: TimingStatistics.nbytes].cast("q")


def _quantile(histogram: NDArray[np.int64], share: float, largest: np.int64) -> float:
    # The histogram's own sum: while another process counts, the number of ticks may be one ahead of it.
    total = int(histogram.sum())
    if total == 0 or largest <= 0:
        return 0.0
    index = int(np.searchsorted(np.cumsum(histogram), math.ceil(share * total)))
    upper = _EDGES_NS[index] if index < len(_EDGES_NS) else int(largest)
    return min(upper, int(largest)) / 1e9


def _exact_quantile(values: NDArray[np.float64], share: float) -> float:
    return float(np.quantile(values, share, method="inverted_cdf")) if values.size else 0.0
