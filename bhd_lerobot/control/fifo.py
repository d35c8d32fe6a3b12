"""Bounded queues between a brain and a cerebellum: commands one way, states the other.

Both lie in one block of memory that the caller may provide, so that the same code serves two parts of one process and
two processes that share the block. Each has one writer and one reader. Neither ever waits: a full command queue
refuses, and the state ring overwrites its oldest entry.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.errors import ConfigError

_MOST_READS = 100  # a writer overwrites what is being read once in a great while, and never so many times in a row


class CommandFifo:
    """A queue of commands for n simulations.

    One entry holds the commands of all simulations, and a mask of those that it is for. Entries come out by due time,
    and those of equal due time in the order in which they went in: the commands of one simulation, whose due times
    never decrease, come out first in, first out, and none waits for another simulation's that is due later.

    Args:
        n: number of simulations.
        width: number of values in a command.
        capacity: number of entries; one that finds the queue full is refused.
        buffer: memory of at least `nbytes(n, width, capacity)` bytes, zeroed before its first use; new memory if None.
    """

    def __init__(self, n: int, width: int, capacity: int = 256, buffer: Any = None) -> None:
        if capacity < 1:
            raise ConfigError(f"The command queue's capacity is {capacity}; it must be at least 1.")
        self.n, self.width, self.capacity = n, width, capacity
        if buffer is None:
            buffer = bytearray(self.nbytes(n, width, capacity))
        # The writer alone moves the head and the reader alone the tail. An aligned 64-bit store is atomic on every
        # platform that CPython supports, and an entry is complete before the head that publishes it moves.
        header = np.frombuffer(buffer, np.int64, 2)
        self._head, self._tail = header[0:1], header[1:2]
        entries = np.frombuffer(buffer, self._dtype(n, width), capacity, offset=16)
        self._sequence, self._due = entries["sequence"], entries["due_ns"]
        self._mask, self._values = entries["mask"], entries["values"]
        # The next entry, as of a head.
        self._seen_head = -1
        self._next: int | None = None
        self._next_due: int | None = None

    @staticmethod
    def _dtype(n: int, width: int) -> np.dtype:
        return np.dtype(
            [
                ("sequence", np.int64),
                ("due_ns", np.int64),
                ("values", np.float64, (n, width)),
                ("mask", np.bool_, (n,)),
            ],
            align=True,
        )

    @classmethod
    def nbytes(cls, n: int, width: int, capacity: int = 256) -> int:
        """Return the size of the memory block [bytes]."""
        return 16 + capacity * cls._dtype(n, width).itemsize

    def __len__(self) -> int:
        """Return the number of entries in use: those that wait, and those between them; at most the capacity."""
        return min(max(0, int(self._head[0]) - int(self._tail[0])), self.capacity)

    @property
    def pushed(self) -> int:
        """Number of entries that were ever appended."""
        return int(self._head[0])

    def push(self, sequence: int, due_ns: int, values: NDArray[np.float64], mask: NDArray[np.bool_]) -> bool:
        """Append an entry.

        Args:
            sequence: its sequence number.
            due_ns: when it is due [ns].
            values: the commands, shape (n, width).
            mask: the simulations it is for, shape (n,).

        Returns:
            False if the queue was full, and nothing was appended.
        """
        head = int(self._head[0])
        if head - int(self._tail[0]) >= self.capacity:
            return False
        slot = head % self.capacity
        self._sequence[slot], self._due[slot] = sequence, due_ns
        self._values[slot], self._mask[slot] = values, mask
        self._head[0] = head + 1
        return True

    def next_due(self) -> int | None:
        """Return when the next entry is due [ns], or None if nothing waits."""
        if int(self._head[0]) != self._seen_head:
            self._update()
        return self._next_due

    def pop(self, values: NDArray[np.float64], mask: NDArray[np.bool_]) -> tuple[int, int] | None:
        """Take the next entry.

        Args:
            values: where the commands go, shape (n, width).
            mask: where the mask goes, shape (n,).

        Returns:
            Sequence number and due time [ns], or None if nothing waits.
        """
        if self.next_due() is None or self._next is None:
            return None
        slot = self._next % self.capacity
        values[:], mask[:] = self._values[slot], self._mask[slot]
        result = int(self._sequence[slot]), int(self._due[slot])
        self._mask[slot] = False
        if self._next == int(self._tail[0]) == self._seen_head - 1:  # the only one, as nearly always
            self._tail[0] = self._seen_head
            self._next, self._next_due = None, None
        else:
            self._update()
        return result

    def drop(self, ids: NDArray[np.intp]) -> NDArray[np.int64]:
        """Drop what waits for some simulations, and return how many commands of each that were. For the reader."""
        dropped = np.zeros(len(ids), np.int64)
        for slot in self._slots():
            dropped += self._mask[slot, ids]
            self._mask[slot, ids] = False
        self._update()
        return dropped

    def drop_outside(self, lowest: NDArray[np.int64], highest: NDArray[np.int64]) -> NDArray[np.int64]:
        """Drop commands whose sequence numbers are out of range; return how many of each simulation. For the reader.

        Args:
            lowest: the smallest that stay, shape (n,).
            highest: the largest that stay, shape (n,).
        """
        slots = self._slots()
        sequence = self._sequence[slots][:, None]
        outside = self._mask[slots] & ((sequence < lowest) | (sequence > highest))
        self._mask[slots] &= ~outside
        self._update()
        return np.asarray(outside.sum(axis=0))

    def drop_older(self, sequence: int, mask: NDArray[np.bool_]) -> None:
        """Drop what was sent to some simulations before a sequence number and still waits. For the reader.

        Args:
            sequence: the sequence number.
            mask: the simulations, shape (n,).
        """
        if int(self._tail[0]) == int(self._head[0]):
            return
        slots = self._slots()
        older = slots[self._sequence[slots] < sequence]
        if len(older):
            self._mask[np.ix_(older, np.flatnonzero(mask))] = False
            self._update()

    def keep_newest(self, now_ns: int) -> None:
        """Drop every command that is due and that a later one, which is due too, takes the place of. For the reader.

        Args:
            now_ns: what is due by then is due [ns].
        """
        slots = self._slots()
        due = slots[self._due[slots] <= now_ns]
        # From the newest to the oldest: which simulations have had a newer one.
        newer = np.logical_or.accumulate(self._mask[due][::-1], axis=0)[::-1]
        self._mask[due[:-1]] &= ~newer[1:]
        self._update()

    def _slots(self) -> NDArray[np.intp]:
        """Return where the entries in use lie, the oldest first."""
        tail, head = self._ends()
        return np.arange(tail, head) % self.capacity

    def _ends(self) -> tuple[int, int]:
        """Return tail and head; a queue that cannot be, because another process wrote garbage, is emptied."""
        tail, head = int(self._tail[0]), int(self._head[0])
        if not 0 <= head - tail <= self.capacity:
            self._tail[0] = tail = head
        return tail, head

    def _update(self) -> None:
        """Find the next entry, and release the oldest entries that are for no simulation any more."""
        tail, head = self._ends()
        self._seen_head = head
        self._next, self._next_due = None, None
        if tail == head:
            return
        if tail == head - 1:
            slot = tail % self.capacity
            if np.count_nonzero(self._mask[slot]):
                self._next, self._next_due = tail, int(self._due[slot])
            else:
                self._tail[0] = head
            return
        # All at once: a chunk of actions is a hundred entries, and this runs within a tick.
        slots = np.arange(tail, head) % self.capacity
        waiting = np.flatnonzero(self._mask[slots].any(axis=1))
        if not len(waiting):
            self._tail[0] = head
            return
        first = int(self._due[slots[waiting]].argmin())  # of equal ones the first
        self._next = tail + int(waiting[first])
        self._next_due = int(self._due[slots[waiting[first]]])
        self._tail[0] = tail + int(waiting[0])


class StateRing:
    """The last states that a cerebellum published, for one writer and any number of readers.

    Each slot is guarded by a counter that is odd while the slot is being written; a reader that sees it change reads
    again, so that it never gets half of one state and half of another.

    Args:
        dtype: the state's numpy dtype.
        capacity: number of slots.
        buffer: memory of at least `nbytes(dtype, capacity)` bytes, zeroed before its first use; new memory if None.
    """

    def __init__(self, dtype: np.dtype, capacity: int = 16, buffer: Any = None) -> None:
        if capacity < 2:
            raise ConfigError(f"The state ring's capacity is {capacity}; it must be at least 2.")
        self.capacity = capacity
        if buffer is None:
            buffer = bytearray(self.nbytes(dtype, capacity))
        self._count = np.frombuffer(buffer, np.int64, 1)
        slots = np.frombuffer(buffer, self._slot(dtype), capacity, offset=8)
        self._guard, self._state = slots["guard"], slots["state"]

    @staticmethod
    def _slot(dtype: np.dtype) -> np.dtype:
        return np.dtype([("guard", np.int64), ("state", dtype)], align=True)

    @classmethod
    def nbytes(cls, dtype: np.dtype, capacity: int = 16) -> int:
        """Return the size of the memory block [bytes]."""
        return 8 + capacity * cls._slot(dtype).itemsize

    def __len__(self) -> int:
        """Return the number of states published so far."""
        return int(self._count[0])

    def publish(self, state: NDArray) -> None:
        """Append a state: a structured array of shape () or a record of the ring's dtype."""
        count = int(self._count[0])
        slot = count % self.capacity
        self._guard[slot] += 1
        self._state[slot] = state
        self._guard[slot] += 1
        self._count[0] = count + 1

    def latest(self) -> NDArray | None:
        """Return a copy of the newest state, or None if there is none yet.

        None also if none could be read whole in many attempts: the reader of a real-time loop does not hang because
        another process wrote garbage.
        """
        for _ in range(_MOST_READS):
            count = len(self)
            if count == 0:
                return None
            state = self.copy(count - 1)
            if state is not None:
                return state
        return None

    def copy(self, number: int) -> NDArray | None:
        """Return a copy of one state, or None if it has been overwritten.

        Args:
            number: how many were published before it; it must have been published.
        """
        slot = number % self.capacity
        complete = 2 * (number // self.capacity + 1)
        if int(self._guard[slot]) != complete:
            return None
        state = self._state[slot].copy()
        return state if int(self._guard[slot]) == complete else None


class RingReader:
    """Reads every state of a ring once, in order, and counts those that were overwritten before it came to them.

    Attributes:
        drops: states lost so far.

    Args:
        ring: the ring; states that were published before are not read.
    """

    def __init__(self, ring: StateRing) -> None:
        self._ring = ring
        self._next = len(ring)
        self.drops = 0

    def read(self) -> NDArray | None:
        """Return a copy of the next state, or None if none has been published since the last."""
        while (published := len(self._ring)) > self._next:
            number = self._next
            self._next += 1
            # The writer may be about to overwrite the oldest, so it is skipped.
            oldest = published - self._ring.capacity + 1
            if number < oldest:
                self.drops += oldest - number
                self._next = oldest
                continue
            state = self._ring.copy(number)
            if state is not None:
                return state
            self.drops += 1
        return None
