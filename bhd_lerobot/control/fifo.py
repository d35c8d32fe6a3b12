"""Bounded queues between a brain and a cerebellum: commands one way, states the other.

Both lie in one block of memory that the caller may provide, so that the same code serves two parts of one process and
two processes that share the block. Each has one writer and one reader. Neither ever waits: a full command queue
refuses, and the state ring overwrites its oldest entry.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.control.kernels import fence, kernel
from bhd_lerobot.control.record import NEVER, QUEUE, WAITING
from bhd_lerobot.errors import ConfigError

_NEVER_DUE = np.iinfo(np.int64).min
_MOST_DROPS = 1 << 32  # states that may have been overwritten since the last that was read
_MOST_READS = 100  # a writer overwrites what is being read once in a great while, and never so many times in a row


class CommandFifo:
    """The queues of commands of n robots, each with an end for its sender and one for its tick.

    Entries come out by due time, and those of equal due time in the order in which they went in.

    Args:
        n: number of robots.
        width: number of values in a command.
        capacity: number of entries of each; a command that finds the queue full is refused. At most 256.
        buffer: memory of at least `nbytes(n)` bytes, zeroed before its first use; new memory if None.

    Attributes:
        queues: the queues as the tick reads them, shape (n,).
        sent_sequence: sequence number of the last command that this end has sent, shape (n,).
        sent_due_ns: when it is due, shape (n,).
    """

    def __init__(self, n: int, width: int, capacity: int = QUEUE, buffer: Any = None) -> None:
        if not 1 <= capacity <= QUEUE:
            raise ConfigError(f"The command queue's capacity is {capacity}; it must be from 1 to {QUEUE}.")
        self.n, self.width, self.capacity = n, width, capacity
        self.queues = np.zeros(n, WAITING) if buffer is None else np.frombuffer(buffer, WAITING, n)
        self._head, self._tail = self.queues["head"], self.queues["tail"]
        self._sequence, self._due = self.queues["sequence"], self.queues["due_ns"]
        self._waits, self._values = self.queues["waits"], self.queues["values"][:, :, :width]
        self._all = np.arange(n)
        self.sent_sequence, self.sent_due_ns = self._head - 1, np.full(n, _NEVER_DUE)

    def forget(self, ids: NDArray[np.intp]) -> None:
        """Take commands of any due time and sequence number next: robots have been put somewhere else."""
        self.sent_sequence[ids], self.sent_due_ns[ids] = -1, _NEVER_DUE

    @classmethod
    def nbytes(cls, n: int) -> int:
        """Return the size of the memory block [bytes]."""
        return n * WAITING.itemsize

    def __len__(self) -> int:
        """Return the number of entries in use of the fullest queue: those that wait, and those between them."""
        most = max(head - tail for head, tail in zip(self._head.tolist(), self._tail.tolist(), strict=True))
        return min(max(most, 0), self.capacity)

    def push(
        self, sequence: int, due_ns: int, values: NDArray[np.float64], mask: NDArray[np.bool_]
    ) -> NDArray[np.bool_]:
        """Append a command.

        Args:
            sequence: its sequence number.
            due_ns: when it is due [ns].
            values: of each robot, shape (n, width).
            mask: the robots that it is for, shape (n,).

        Returns:
            Whether it was appended for each robot, shape (n,): not where the queue was full, or `mask` is False.
        """
        has_room: NDArray[np.bool_] = mask & (self._head - self._tail < self.capacity)
        ids = self._all if np.count_nonzero(has_room) == self.n else np.flatnonzero(has_room)
        slots = self._head[ids] % QUEUE
        self._sequence[ids, slots], self._due[ids, slots] = sequence, due_ns
        self._values[ids, slots], self._waits[ids, slots] = values[ids], True
        fence()
        self._head[ids] += 1
        return has_room


@kernel()
def ends(queue: Any) -> tuple[int, int]:
    """Return the numbers of the oldest entry and of the next; garbage of another process empties the queue."""
    tail, head = queue.tail, queue.head
    fence()
    # Compiled, the difference of two numbers may have the wrong sign.
    if not (tail <= head and 0 <= head - tail <= QUEUE):
        queue.tail = tail = head
    return tail, head


@kernel()
def find_next(state: Any, queue: Any) -> None:
    """Note when the next entry of a queue is due, and release the oldest entries that do not wait any more."""
    tail, head = ends(queue)
    state.seen_head, state.next_due_ns = head, NEVER
    is_first = True
    for number in range(tail, head):
        slot = number % QUEUE
        if not queue.waits[slot]:
            continue
        if is_first:
            queue.tail, is_first = number, False
        due_ns = min(queue.due_ns[slot], NEVER - 1)
        if due_ns < state.next_due_ns:
            state.next_due_ns, state.next_entry = due_ns, slot
    if is_first:
        queue.tail = head


@kernel()
def drop(state: Any, queue: Any, lowest: int, highest: int) -> int:
    """Drop what waits and has a sequence number in a range; return how many that were."""
    dropped = 0
    tail, head = ends(queue)
    for number in range(tail, head):
        slot = number % QUEUE
        if queue.waits[slot] and lowest <= queue.sequence[slot] <= highest:
            queue.waits[slot] = False
            dropped += 1
    find_next(state, queue)
    return dropped


@kernel()
def keep_newest(state: Any, queue: Any, now_ns: int) -> None:
    """Drop every entry that is due and that a later one, which is due too, takes the place of."""
    newest = -1
    tail, head = ends(queue)
    for number in range(tail, head):
        slot = number % QUEUE
        if queue.waits[slot] and queue.due_ns[slot] <= now_ns:
            if newest >= 0:
                queue.waits[newest] = False
            newest = slot
    find_next(state, queue)


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
        self.dtype, self.capacity = dtype, capacity
        if buffer is None:
            buffer = bytearray(self.nbytes(dtype, capacity))
        self._count = np.frombuffer(buffer, np.int64, 1)
        self._published = len(self)
        slot = self._slot(dtype)
        self._guard = np.frombuffer(buffer, slot, capacity, offset=8)["guard"]
        # As bytes: numpy copies a structure field by field, and a record has a hundred of them.
        rows = np.frombuffer(buffer, np.uint8, capacity * slot.itemsize, offset=8).reshape(capacity, slot.itemsize)
        start = slot.fields["state"][1]  # type: ignore[index]
        self._rows = rows[:, start : start + dtype.itemsize]

    @staticmethod
    def _slot(dtype: np.dtype) -> np.dtype:
        return np.dtype([("guard", np.int64), ("state", dtype)], align=True)

    @classmethod
    def nbytes(cls, dtype: np.dtype, capacity: int = 16) -> int:
        """Return the size of the memory block [bytes]."""
        return 8 + capacity * cls._slot(dtype).itemsize

    def __len__(self) -> int:
        """Return the number of states published so far."""
        return max(0, int(self._count[0]))

    def publish(self, state: NDArray) -> None:
        """Append a state: a structured array of shape () or a record of the ring's dtype."""
        lap, slot = divmod(self._published, self.capacity)
        self._guard[slot] = 2 * lap + 1
        fence()
        self._rows[slot] = np.frombuffer(state, np.uint8)
        self._guard[slot] = 2 * lap + 2
        fence()
        self._published += 1
        self._count[0] = self._published

    def latest(self) -> NDArray | None:
        """Return a copy of the newest state, or None if there is none yet.

        None also if none could be read whole in many attempts: the reader of a real-time loop does not hang because
        another process wrote garbage.
        """
        for _ in range(_MOST_READS):
            count = len(self)
            if count == 0:
                return None
            fence()
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
        fence()
        state = self._rows[slot].copy()
        fence()
        return state.view(self.dtype)[0] if int(self._guard[slot]) == complete else None


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
        while (published := len(self._ring)) != self._next:
            if not 0 < published - self._next < _MOST_DROPS:
                self._next = published  # a count that cannot be, because another process wrote garbage, or its end
                return None
            fence()
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
