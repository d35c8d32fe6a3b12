"""Ending a run from outside, without losing what it has."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class StopRequest:
    """Whether, and by which `signal`, the run was asked to end."""

    def __init__(self) -> None:
        self.signal: signal.Signals | None = None

    def __bool__(self) -> bool:
        """Whether the run was asked to end."""
        return self.signal is not None

    @property
    def name(self) -> str:
        """The signal's name, empty if there was none."""
        return self.signal.name if self.signal else ""

    @property
    def exit_status(self) -> int:
        """The exit status that states which signal ended the run, 0 if none did."""
        return 0 if self.signal is None else 128 + self.signal


@contextmanager
def stop_on_signals() -> Iterator[StopRequest]:
    """Turn the first Ctrl-C, SIGTERM or SIGHUP into a request that the run's loop reads between two frames.

    A second one acts as it would without us: the loop might hang. A second SIGHUP does nothing: when a session is
    closed, the shell and the system both send one. A signal that is ignored, as under nohup, stays so. The former
    handlers come back at the end. Python gives signals to its main thread only; a run in another one is not ended by
    them.
    """
    request = StopRequest()
    if threading.current_thread() is not threading.main_thread():
        yield request
        return
    former: dict[signal.Signals, Any] = {}

    def handle(number: int, frame: FrameType | None) -> None:
        request.signal = signal.Signals(number)
        for one, handler in former.items():
            signal.signal(one, signal.SIG_IGN if one == number == signal.SIGHUP else handler)

    for one in _SIGNALS:
        if signal.getsignal(one) is not signal.SIG_IGN:  # as by nohup
            former[one] = signal.signal(one, handle)
    try:
        yield request
    finally:
        for one, handler in former.items():
            signal.signal(one, handler)
