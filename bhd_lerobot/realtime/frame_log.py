"""The recorder of a running robot: takes every state from the ring and keeps those that frames begin and end with.

Runs in a process of its own, so that nothing that happens in the brain's process (inference, the saving of an episode,
the encoding of a video) keeps it from the ring. What it keeps lies in shared memory: no frame is ever pickled.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.control.fifo import RingReader, StateRing


class FrameLog:
    """The states at the boundaries of frames, for one writer and one reader; overwriting.

    Boundary k of a segment is the first state at or after tick k F - 1, where F is the number of ticks in a frame: the
    state that a frame's ticks end with, and its successor begins with.

    Args:
        state: dtype of the states.
        capacity: boundaries that the reader may lag behind.
        buffer: memory of at least `nbytes(state, capacity)` bytes, zeroed; new memory if None.
    """

    def __init__(self, state: np.dtype, capacity: int, buffer: Any = None) -> None:
        if buffer is None:
            buffer = bytearray(self.nbytes(state, capacity))
        self.dtype = self._entry(state)
        self._log = StateRing(self.dtype, capacity, buffer)

    @staticmethod
    def _entry(state: np.dtype) -> np.dtype:
        """Return the dtype of an entry.

        Beside the state: ``frame``, the number of the boundary; ``lateness_ns``, the latest start of a tick since the
        last boundary; ``drops``, states of the segment that were lost so far.
        """
        counts = [(name, np.int64) for name in ("frame", "lateness_ns", "drops")]
        return np.dtype([*counts, ("state", state)])

    @classmethod
    def nbytes(cls, state: np.dtype, capacity: int) -> int:
        """Return the size of the memory block [bytes]."""
        return StateRing.nbytes(cls._entry(state), capacity)

    def append(self, entry: NDArray) -> None:
        """Add a boundary."""
        self._log.publish(entry)

    def reader(self) -> RingReader:
        """Return a reader of the boundaries that are added from now on."""
        return RingReader(self._log)


class FrameCollector:
    """Turns the states of a ring into boundaries of frames.

    Attributes:
        drops: states of the present segment that were overwritten before they could be taken.

    Args:
        frame_ticks: ticks in a frame.
    """

    def __init__(self, ring: StateRing, log: FrameLog, frame_ticks: int) -> None:
        self._reader, self._log, self._frame_ticks = RingReader(ring), log, frame_ticks
        self._entry = np.zeros((), log.dtype)
        self._segment = -1
        self._next = 0
        self._latest = 0
        self.states = self.drops = 0

    def drain(self) -> int:
        """Take all states that are there; return how many boundaries that gave."""
        found = 0
        while (state := self._reader.read()) is not None:
            found += self._take(state)
        return found

    def _take(self, state: NDArray) -> int:
        segment, tick = int(state["segment"]), int(state["tick"])
        if segment != self._segment:
            self._segment, self._next, self.states, self._latest = segment, 0, 0, 0
        self.states += 1
        # A segment begins with one state before its first tick.
        self.drops = int(state["executed"]) + 1 - self.states
        self._latest = max(self._latest, int(state["start_ns"]) - int(state["due_ns"]))
        boundary = (tick + 1) // self._frame_ticks
        if boundary < self._next:
            return 0
        self._next = boundary + 1
        entry = self._entry
        entry["frame"], entry["state"] = boundary, state
        entry["lateness_ns"], entry["drops"] = self._latest, self.drops
        self._log.append(entry)
        self._latest = 0
        return 1
