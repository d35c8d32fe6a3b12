"""The absolute grid of a periodic loop, and what to do when a tick comes late. Pure: no clock in here."""

from dataclasses import dataclass

from bhd_lerobot.errors import ConfigError


@dataclass(frozen=True)
class Slot:
    """A tick to be run now.

    Attributes:
        index: its number on the grid.
        due_ns: when it was due [ns].
        lateness_ns: how long after that it starts [ns].
        skipped: how many ticks before it were given up because an earlier one was late.
    """

    index: int
    due_ns: int
    lateness_ns: int
    skipped: int


class TickGrid:
    """Ticks at t0 + k T, for ever: a tick that comes late does not move its successors.

    When the loop comes back after one or more whole periods, the ticks that were missed are skipped, the newest one
    that is due is run in their place, and the phase stays: k grows by what was skipped. Executed and skipped ticks
    together are the periods that have passed.

    Args:
        start_ns: when tick 0 is due [ns].
        period_ns: T [ns].
        most_misses: so many starts in a row that each skip a tick are too many.

    Attributes:
        executed: ticks run so far.
        skipped: ticks given up so far.
        overruns: ticks that ended after their successor was due.
    """

    def __init__(self, start_ns: int, period_ns: int, most_misses: int = 10) -> None:
        if period_ns < 1 or most_misses < 1:
            raise ConfigError(f"period_ns is {period_ns} and most_misses is {most_misses}; both must be at least 1.")
        self.start_ns, self.period_ns, self.most_misses = start_ns, period_ns, most_misses
        self.executed = self.skipped = self.overruns = 0
        self._next = 0
        self._misses = 0

    @property
    def next_due_ns(self) -> int:
        """When the next tick is due [ns]."""
        return self.start_ns + self._next * self.period_ns

    @property
    def too_many_misses(self) -> bool:
        """Whether the last starts all came so late that ticks were skipped."""
        return self._misses >= self.most_misses

    def begin(self, now_ns: int) -> Slot:
        """Return the tick to be run at a time at which the next one is due.

        Args:
            now_ns: not before `next_due_ns` [ns]; a clock that is early by its resolution counts as on time.
        """
        behind = max(0, now_ns - self.next_due_ns) // self.period_ns
        index = self._next + behind
        due = self.start_ns + index * self.period_ns
        self._next = index + 1
        self.executed += 1
        self.skipped += behind
        self._misses = self._misses + 1 if behind else 0
        return Slot(index, due, max(0, now_ns - due), behind)

    def end(self, now_ns: int) -> None:
        """Note that the tick has been run."""
        self.overruns += now_ns > self.next_due_ns
