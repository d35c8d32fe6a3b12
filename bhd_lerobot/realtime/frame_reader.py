"""The frames of a running robot, read from its ring of states by whoever needs them, as late as the ring is long."""

from dataclasses import dataclass
from typing import Any

from bhd_lerobot.control.fifo import RingReader, StateRing


@dataclass(frozen=True)
class Boundary:
    """A state that the ticks of a frame end with, and its successor begins with.

    Boundary k of a segment is the first state at or after tick k F - 1, where F is the number of ticks in a frame.

    Attributes:
        frame: its number, k.
        state: the state.
        lateness_ns: the latest start of a tick since the last boundary that was read [ns].
        drops: states that were overwritten before they were read, so far.
    """

    frame: int
    state: Any
    lateness_ns: int
    drops: int


class FrameReader:
    """Reads every boundary once, in order; a state that was overwritten before it was read is lost, and counted.

    Args:
        ring: the states; those that were published before are not read.
        frame_ticks: ticks in a frame.
    """

    def __init__(self, ring: StateRing, frame_ticks: int) -> None:
        self._reader, self._frame_ticks = RingReader(ring), frame_ticks
        self._segment = -1
        self._next = self._latest = 0

    def read(self) -> Boundary | None:
        """Return the next boundary, or None if there is none yet."""
        while (state := self._reader.read()) is not None:
            segment: Any = state["segment"]
            if segment != self._segment:
                self._segment, self._next, self._latest = segment, 0, 0
            self._latest = max(self._latest, int(state["start_ns"]) - int(state["due_ns"]))
            frame = (int(state["tick"]) + 1) // self._frame_ticks
            if frame >= self._next:
                boundary = Boundary(frame, state, self._latest, self._reader.drops)
                self._next, self._latest = frame + 1, 0
                return boundary
        return None
