"""When messages were measured, on this machine's monotonic clock, from stamps of another machine's clock."""

from collections import deque

_WINDOW = 100  # messages of a topic that its offset is estimated from
_JUMP_NS = 1_000_000_000  # a stamp that is further off than this is of a clock that was set
_APART_NS = 500_000_000  # topics of one clock whose offsets differ by more: it was set, and one of them is from before
_RECENT_NS = 5_000_000_000  # an offset that is older counts for no other topic: clocks drift


class ClockOffsets:
    """Estimates by how much the clocks of topics are behind, as the smallest delay among the newest messages.

    What arrives earliest was delayed least; the delay of that message itself cannot be told from an offset, and counts
    as one. Among topics of one clock the smallest delay is that of all: a scan that is sent at the end of its turn, and
    stamped at the beginning, is then as old as it is. A clock that is set starts the estimate of a topic anew.

    Attributes:
        jumps: how often the clock of each topic was set.

    Args:
        n: number of topics.
        are_one: whether their stamps are of one clock.
    """

    def __init__(self, n: int, *, are_one: bool = False) -> None:
        self._are_one = are_one
        self._differences: list[deque[int]] = [deque(maxlen=_WINDOW) for _ in range(n)]
        self._offsets: dict[int, tuple[int, int]] = {}  # of each topic the smallest difference, and when it came
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
        if differences and abs(difference - self._offsets[topic][0]) > _JUMP_NS:
            differences.clear()
            self.jumps[topic] += 1
        differences.append(difference)
        own = offset = min(differences)
        self._offsets[topic] = own, arrived_ns
        if self._are_one:
            for other, newest_ns in self._offsets.values():
                if abs(other - own) <= _APART_NS and arrived_ns - newest_ns <= _RECENT_NS:
                    offset = min(offset, other)
        return min(arrived_ns, stamp_ns + offset)
