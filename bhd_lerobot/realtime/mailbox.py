"""A bounded queue of records of fixed size from one process to another, or from one part of a process to another."""

from typing import Any

import numpy as np

from bhd_lerobot.control.kernels import fence
from bhd_lerobot.errors import ConfigError


class Mailbox:
    """Records from one writer to one reader, in order. It never waits: a full one refuses.

    Attributes:
        dtype: the dtype of the records.

    Args:
        dtype: the dtype of the records.
        capacity: number of records; one that finds the mailbox full is refused.
        buffer: memory of at least `nbytes(dtype, capacity)` bytes, zeroed before its first use; new memory if None.
    """

    def __init__(self, dtype: np.dtype, capacity: int = 16, buffer: Any = None) -> None:
        if capacity < 1:
            raise ConfigError(f"The mailbox's capacity is {capacity}; it must be at least 1.")
        self.dtype, self.capacity = dtype, capacity
        if buffer is None:
            buffer = bytearray(self.nbytes(dtype, capacity))
        # As in `CommandFifo`: the writer alone moves the head and the reader alone the tail, each with one aligned
        # 64-bit store, and a record is complete before the head that publishes it moves.
        header = np.frombuffer(buffer, np.int64, 2)
        self._head, self._tail = header[0:1], header[1:2]
        self._records = np.frombuffer(buffer, self._slot(dtype), capacity, offset=16)["record"]

    @staticmethod
    def _slot(dtype: np.dtype) -> np.dtype:
        return np.dtype([("record", dtype), ("align", np.int64, (0,))], align=True)

    @classmethod
    def nbytes(cls, dtype: np.dtype, capacity: int = 16) -> int:
        """Return the size of the memory block [bytes]."""
        return 16 + capacity * cls._slot(dtype).itemsize

    def __len__(self) -> int:
        """Return the number of records that wait; at most the capacity."""
        return min(max(0, self._head.item() - self._tail.item()), self.capacity)

    @property
    def full(self) -> bool:
        """Whether the next record would be refused."""
        return len(self) >= self.capacity

    def post(self, record: Any) -> bool:
        """Append a record of the mailbox's dtype; False if it was full, and nothing was appended."""
        head = self._head.item()
        if head - self._tail.item() >= self.capacity:
            return False
        self._records[head % self.capacity] = record
        fence()
        self._head[0] = head + 1
        return True

    def take(self) -> Any:
        """Take the oldest record: a copy, or None if none waits."""
        head, tail = self._head.item(), self._tail.item()
        if head == tail:
            return None
        if not 0 < head - tail <= self.capacity:
            self._tail[0] = head  # ends that cannot be, because another process wrote garbage
            return None
        fence()
        record = self._records[tail % self.capacity].copy()
        fence()
        self._tail[0] = tail + 1
        return record
