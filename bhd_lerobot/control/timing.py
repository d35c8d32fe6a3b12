"""How punctual a loop is: a histogram of lateness that costs no memory, overruns, quantiles. Pure: no clock in here."""

from dataclasses import dataclass

import numpy as np

# Logarithmic bins, 20 a decade from 1 us to 10 s: a quantile read from them is at most 12 % too high.
_EDGES_NS = np.round(1_000 * 10 ** (np.arange(141) / 20)).astype(np.int64)


@dataclass(frozen=True)
class TimingSummary:
    """What happened on a loop, times in seconds.

    Attributes:
        ticks: number of ticks.
        overruns: ticks that ended after their successor was due.
        lateness_p50: half the ticks started no later after they were due.
        lateness_p99: 99 % of the ticks started no later after they were due.
        lateness_max: the latest start.
        duration_max: the longest tick.
    """

    ticks: int
    overruns: int
    lateness_p50: float
    lateness_p99: float
    lateness_max: float
    duration_max: float


class TimingStatistics:
    """Collects start and end of every tick of a periodic loop.

    Args:
        period_ns: the loop's period [ns].
    """

    def __init__(self, period_ns: int) -> None:
        self.period_ns = period_ns
        self._histogram = np.zeros(len(_EDGES_NS) + 1, np.int64)
        self._ticks = self._overruns = self._latest = self._longest = 0

    def add(self, due_ns: int, start_ns: int, end_ns: int) -> None:
        """Count one tick.

        Args:
            due_ns: when it was due [ns].
            start_ns: when it started [ns].
            end_ns: when it ended [ns].
        """
        lateness = max(0, start_ns - due_ns)
        self._histogram[np.searchsorted(_EDGES_NS, lateness, side="left")] += 1
        self._ticks += 1
        self._overruns += end_ns > due_ns + self.period_ns
        self._latest = max(self._latest, lateness)
        self._longest = max(self._longest, end_ns - start_ns)

    def add_punctual(self, ticks: int) -> None:
        """Count ticks of a simulated clock, which are on time by construction."""
        self._histogram[0] += ticks
        self._ticks += ticks

    def summary(self) -> TimingSummary:
        """Return what happened so far."""
        return TimingSummary(
            ticks=self._ticks,
            overruns=self._overruns,
            lateness_p50=self._quantile(0.50),
            lateness_p99=self._quantile(0.99),
            lateness_max=self._latest / 1e9,
            duration_max=self._longest / 1e9,
        )

    def _quantile(self, share: float) -> float:
        if self._ticks == 0 or self._latest == 0:
            return 0.0
        rank = int(np.ceil(share * self._ticks))
        index = int(np.searchsorted(np.cumsum(self._histogram), rank))
        upper = int(_EDGES_NS[index]) if index < len(_EDGES_NS) else self._latest
        return min(upper, self._latest) / 1e9
