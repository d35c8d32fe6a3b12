"""Calls of a device on a thread of its own, with a deadline."""

import queue
import threading
import time
from collections.abc import Callable
from typing import Any


class Calls:
    """Makes one call at a time on a thread of its own; one that does not return in time is not waited for.

    Args:
        name: of the thread.
    """

    def __init__(self, name: str) -> None:
        self._wanted: queue.SimpleQueue[Callable[[], Any] | None] = queue.SimpleQueue()
        self._done: queue.SimpleQueue[tuple[Any, Exception | None]] = queue.SimpleQueue()
        self._is_busy = self._is_stale = False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def call(self, function: Callable[[], Any], timeout_s: float) -> tuple[bool, Any]:
        """Return whether a call has returned in time, and what; a call that is still under way is waited for first.

        What a late call returns is returned by the next: it is newer than nothing.

        Raises:
            Exception: what the call raised.
        """
        end = time.monotonic() + timeout_s
        is_newest = False
        while not is_newest:
            if not self._is_busy:
                self._wanted.put(function)
                self._is_busy = True
            try:
                result, error = self._done.get(timeout=max(0.0, end - time.monotonic()))
            except queue.Empty:
                return False, None
            is_newest = not self._is_stale
            self._is_busy = self._is_stale = False
        if error is not None:
            raise error
        return True, result

    def forget(self) -> None:
        """Drop what the call that is under way will return: it belongs to what is over."""
        self._is_stale = self._is_busy

    def close(self) -> None:
        """End the thread, after the call that is under way."""
        self._wanted.put(None)

    def _run(self) -> None:
        while (function := self._wanted.get()) is not None:
            try:
                self._done.put((function(), None))
            except Exception as error:  # raised again in the thread that asked
                self._done.put((None, error))
