"""When a message was measured, on this machine's monotonic clock, from a stamp of another machine's clock."""

from collections import deque

_WINDOW = 100  # messages that the offset is estimated from
_JUMP_NS = 1_000_000_000  # a stamp that is further off than this is of a clock that was set


class ClockOffset:
    """Estimates by how much a sender's clock is behind, as the smallest delay among the newest messages.

    What arrives earliest was delayed least; the delay of that message itself cannot be told from an offset, and counts
    as one. A clock that is set starts the estimate anew.

    Attributes:
        jumps: how often the clock was set.
    """

    def __init__(self) -> None:
        self._differences: deque[int] = deque(maxlen=_WINDOW)
        self.jumps = 0

    def measured_ns(self, stamp_ns: int, arrived_ns: int) -> int:
        """Return when a message was measured, never after it arrived.

        Args:
            stamp_ns: its stamp, on the sender's clock [ns]; 0 if it has none.
            arrived_ns: when it arrived, monotonic [ns].
        """
        if not stamp_ns:
            return arrived_ns
        difference = arrived_ns - stamp_ns
        if self._differences and abs(difference - min(self._differences)) > _JUMP_NS:
            self._differences.clear()
            self.jumps += 1
        self._differences.append(difference)
        return min(arrived_ns, stamp_ns + min(self._differences))
