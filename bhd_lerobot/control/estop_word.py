"""The word of the emergency stop: any process presses, only the cerebellum acknowledges."""

import time
from typing import Any

import numpy as np
from numpy.typing import NDArray


class EstopWord:
    """Presses of the emergency stops of n robots, and those that are acknowledged.

    A press is one store of the present time, which no two presses share. An acknowledgement is a store of the press
    that it is for, in another place: a press that comes while the cerebellum acknowledges an earlier one is not lost.

    Attributes:
        is_shared: whether other processes may press: then only a request of one that saw the press acknowledges it.
        words: presses, what is acknowledged, and what a tick has seen, each of shape (n,).
        latched: the last presses that the cerebellum has seen, shape (n,).

    Args:
        n: number of robots.
        memory: 3 n 64-bit integers, the presses, what is acknowledged, and what was seen; new memory if None.
    """

    def __init__(self, n: int, memory: Any = None) -> None:
        self.is_shared = memory is not None
        words = np.zeros(3 * n, np.int64) if memory is None else np.frombuffer(memory, np.int64, 3 * n)
        self.words: NDArray[np.int64] = words.reshape(3, n)
        self._pressed, self._acknowledged, self.latched = self.words
        self._flags = np.zeros(n, np.bool_)

    def press(self, ids: NDArray[np.intp] | None = None) -> None:
        """Press the emergency stop of some robots, of all if None. From any process and thread."""
        self._pressed[slice(None) if ids is None else ids] = time.monotonic_ns()

    @property
    def pressed(self) -> NDArray[np.bool_]:
        """Whether there is a press that was not acknowledged, shape (n,); valid until it is asked for again."""
        return np.not_equal(self._pressed, self._acknowledged, out=self._flags)

    def acknowledge(self, mask: NDArray[np.bool_], press: int | None = None) -> None:
        """Acknowledge the presses of some robots that were seen, and no later ones. For the cerebellum.

        Args:
            mask: the robots, shape (n,).
            press: the one press that may be; the last that was seen if None.
        """
        np.copyto(self._acknowledged, self.latched, where=mask if press is None else mask & (self.latched == press))
