"""When a message was measured, on this machine's monotonic clock, from its stamp and the time at which it was sent."""

from collections import deque

import numpy as np

_BUCKET_NS = 50_000_000  # of the messages in so much time, the one that was delayed least is kept
_BUCKETS = 100
_RATE_NS = 2_000_000_000  # the least time from which the rate of a clock is estimated
_RATE_POINTS = 8
_NO_DRIFT = 0.02  # a rate that is nearer to 1 is 1: what clocks drift is far less
_JUMP_NS = 1_000_000_000  # a stamp that is further off than this is of a clock that was set
_AHEAD_NS = 20_000_000  # a stamp may be ahead of the sending: two readings of one clock, rounded
_OLDEST_NS = 2_000_000_000  # a stamp that is older than this when it is sent is of another clock
_EXCESS_NS = 250_000_000  # the most that a stamp of a clock of its own makes a message older than its sending


class _Line:
    """Where times of one clock are on another: the smallest delay in the last seconds, at the rate of the clock.

    Args:
        has_rate: whether the rate is estimated; otherwise it is 1.
    """

    def __init__(self, *, has_rate: bool) -> None:
        self._has_rate, self._before = has_rate, 0.0  # the delay of the message before [ns]
        self._points: deque[tuple[int, int]] = deque(maxlen=_BUCKETS)
        self._period, self._least = (
            1.0,
            0.0,
        )  # ns of ours per ns of theirs; the smallest delay from the first point [ns]

    @property
    def rate(self) -> float:
        """How fast the other clock goes, of real time."""
        return 1 / self._period

    def at(self, theirs: int, ours: int) -> int:
        """Return when it was `theirs` there, never after `ours`, the time at which that was learned here [ns]."""
        if self._points and abs(self._delay(theirs, ours) - self._before) > _JUMP_NS:
            self._points.clear()
            self._period = 1.0
        points = self._points
        if not points or ours // _BUCKET_NS != points[-1][1] // _BUCKET_NS:
            points.append((theirs, ours))
            self._fit()
        elif ours - theirs < points[-1][1] - points[-1][0]:
            points[-1] = theirs, ours
        delay = self._before = self._delay(theirs, ours)
        self._least = min(self._least, delay)
        return ours - round(delay - self._least)

    def _delay(self, theirs: int, ours: int) -> float:
        first_theirs, first_ours = self._points[0]
        return (ours - first_ours) - self._period * (theirs - first_theirs)

    def _fit(self) -> None:
        theirs, ours = (np.array(self._points, np.int64) - np.array(self._points[0])).T.astype(np.float64)
        enough = self._has_rate and len(ours) >= _RATE_POINTS and ours[-1] >= _RATE_NS and theirs[-1] > 0
        period = float(np.polyfit(theirs, ours, 1)[0]) if enough else self._period
        self._period = 1.0 if abs(period - 1) < _NO_DRIFT or period <= 0 else period
        self._least = float((ours - self._period * theirs).min())


class ClockOffset:
    """Finds out when the messages of a topic were measured.

    A message carries when it was sent, by the clock of the machine that sent it. Where that is this machine's clock, it
    is known how long the message was on its way; otherwise the smallest delay of the last seconds counts as none. Its
    stamp is of the same clock if it is a little older than the sending. Any other stamp, as of a simulation, is of a
    clock with a rate of its own, which may be set.

    Args:
        is_synchronised: whether the sender's clock is that of this machine.
    """

    def __init__(self, *, is_synchronised: bool = False) -> None:
        self._is_synchronised = is_synchronised
        self._network, self._clock = _Line(has_rate=False), _Line(has_rate=True)
        self._stamp_ns = self._sent_ns = 0
        self._has_own_clock = False

    @property
    def rate(self) -> float:
        """How fast the stamps' clock goes, of real time; of the sender's own clock 1."""
        return self._clock.rate

    def measured_ns(self, stamp_ns: int, arrived_ns: int, sent_ns: int = 0, wall_ns: int = 0) -> int:
        """Return when a message was measured, never after it arrived.

        Args:
            stamp_ns: its stamp, on the sender's clock [ns]; 0 if it has none.
            arrived_ns: when it arrived, monotonic [ns].
            sent_ns: when it was sent, on the clock of the sender's machine [ns]; 0 if that is not known.
            wall_ns: when it arrived, on the clock of this machine [ns].
        """
        sent_at = self._sent_at(arrived_ns, sent_ns, wall_ns)
        before, self._stamp_ns = self._stamp_ns, stamp_ns
        if not stamp_ns or stamp_ns == before:  # there is no clock, or it stands
            return sent_at
        age = sent_ns - stamp_ns
        self._has_own_clock |= not -_AHEAD_NS <= age <= _OLDEST_NS or stamp_ns < before
        if not self._has_own_clock:
            return sent_at - max(age, 0)
        measured = self._clock.at(stamp_ns, sent_at)
        return max(measured, sent_at - _EXCESS_NS) if sent_ns else measured

    def _sent_at(self, arrived_ns: int, sent_ns: int, wall_ns: int) -> int:
        """Return when a message was sent, monotonic [ns]."""
        if not sent_ns:
            return arrived_ns
        if self._is_synchronised and 0 <= wall_ns - sent_ns <= _OLDEST_NS:
            return arrived_ns - (wall_ns - sent_ns)
        if sent_ns < self._sent_ns:  # the machine's clock was set
            self._network = _Line(has_rate=False)
        self._sent_ns = sent_ns
        return self._network.at(sent_ns, arrived_ns)
