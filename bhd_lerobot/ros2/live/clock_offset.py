"""When messages were measured, on this machine's monotonic clock, from stamps of another machine's clock."""

from collections import deque

_WINDOW = 100  # messages of a topic that its offset is estimated from
_JUMP_NS = 1_000_000_000  # a stamp that is further off than this is of a clock that was set
_SAME_NS = 500_000_000  # topics whose offsets differ by more have different clocks


class ClockOffsets:
    """Estimates by how much a sender's clock is behind, as the smallest delay among the newest messages of its topics.

    What arrives earliest was delayed least; the delay of that message itself cannot be told from an offset, and counts
    as one. Topics whose offsets are nearly the same have one clock: a scan that is sent at the end of its turn, and
    stamped at the beginning, is then as old as it is. A clock that is set starts the estimate of a topic anew.

    Attributes:
        jumps: how often the clock of each topic was set.

    Args:
        n: number of topics.
    """

    def __init__(self, n: int) -> None:
        self._differences: list[deque[int]] = [deque(maxlen=_WINDOW) for _ in range(n)]
        self._offsets: dict[int, int] = {}  # the smallest difference of each topic
        self.jumps = [0] * n

    def measured_ns(self, topic: int, stamp_ns: int, arrived_ns: int) -> int:
        """Return when a message was measured, never after it arrived.

        Args:
            topic: number of its topic.
            stamp_ns: its stamp, on the sender's clock [ns]; 0 if it has none.
            arrived_ns: when it arrived, monotonic [ns].
        """
        if not stamp_ns:
            return arrived_ns
        difference, differences = arrived_ns - stamp_ns, self._differences[topic]
        if differences and abs(difference - self._offsets[topic]) > _JUMP_NS:
            differences.clear()
            self.jumps[topic] += 1
        differences.append(difference)
        self._offsets[topic] = own = min(differences)
        return min(arrived_ns, stamp_ns + min(one for one in self._offsets.values() if abs(one - own) <= _SAME_NS))
