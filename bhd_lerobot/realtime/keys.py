"""Single keys from a terminal, without breaking Ctrl-C, and with the terminal as it was at the end."""

import atexit
import contextlib
import os
import select
import sys
import termios
import threading
import time
import traceback
from collections.abc import Callable
from typing import Any

KeyHandler = Callable[[bytes], None]
"""What gets keys as the terminal sends them; b"" when the terminal is gone. It must not block."""

_BACKGROUND_S = 0.05  # [s] between two looks whether the terminal is this process's again


def standard_input() -> int | None:
    """Return the descriptor of standard input, or None if there is none."""
    try:
        return sys.stdin.fileno()
    except (AttributeError, OSError, ValueError):
        return None


class KeyTerminal:
    """A terminal that gives keys at once and does not show them, until `restore` or the end of the program.

    Signals of the keyboard (Ctrl-C, Ctrl-Z) stay signals. What kills the program without its knowledge leaves the
    terminal as it is; `stty sane` repairs that.

    Args:
        descriptor: a terminal in whose foreground this process is; see `usable`.
    """

    def __init__(self, descriptor: int) -> None:
        self.descriptor = descriptor
        self._former: list[Any] | None = termios.tcgetattr(descriptor)
        mode = termios.tcgetattr(descriptor)
        mode[3] &= ~(termios.ICANON | termios.ECHO)
        mode[6][termios.VMIN], mode[6][termios.VTIME] = 1, 0
        atexit.register(self.restore)
        termios.tcsetattr(descriptor, termios.TCSADRAIN, mode)

    @staticmethod
    def usable(descriptor: int | None) -> bool:
        """Return whether this is a terminal, and this process may use it without being stopped for it."""
        try:
            return descriptor is not None and os.isatty(descriptor) and os.tcgetpgrp(descriptor) == os.getpgrp()
        except OSError:
            return False

    def restore(self) -> None:
        """Put the terminal back to what it was. May be called twice."""
        former, self._former = self._former, None
        atexit.unregister(self.restore)
        if former is not None and self.usable(self.descriptor):
            with contextlib.suppress(termios.error):
                termios.tcsetattr(self.descriptor, termios.TCSADRAIN, former)


class KeySource:
    """The keys of one terminal for everything in this process that wants them; `key_source` returns it.

    Two readers of one terminal would each get some of the keys. Here one thread reads, and every subscriber gets all
    keys, in the order of the subscriptions; the emergency stop subscribes with ``first`` and is called before others.
    The traceback of a handler that raises is printed, and the others are called all the same. The terminal is taken
    with the first subscription and restored with the end of the last.
    """

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._lock = threading.Lock()
        self._handlers: tuple[KeyHandler, ...] = ()
        self._opened: tuple[KeyTerminal, threading.Thread, int] | None = None  # the last ends the thread by a byte

    def subscribe(self, handler: KeyHandler, *, first: bool = False) -> None:
        """Call a handler with the keys from now on, from the thread that reads; before all others if `first`."""
        with self._lock:
            self._handlers = (handler, *self._handlers) if first else (*self._handlers, handler)
            if self._opened is None:
                reader, writer = os.pipe()
                terminal = KeyTerminal(self._descriptor)
                thread = threading.Thread(target=self._work, args=(reader,), name="bhd-keys", daemon=True)
                self._opened = terminal, thread, writer
                thread.start()

    def unsubscribe(self, handler: KeyHandler) -> None:
        """Call a handler no more. May be called twice."""
        with self._lock:
            self._handlers = tuple(one for one in self._handlers if one != handler)
            if self._handlers or self._opened is None:
                return
            (terminal, thread, writer), self._opened = self._opened, None
            os.close(writer)
            terminal.restore()
        if thread is not threading.current_thread():
            thread.join(1.0)

    def _work(self, closing: int) -> None:
        poll = select.poll()
        poll.register(self._descriptor, select.POLLIN)
        poll.register(closing, select.POLLIN)
        try:
            while closing not in dict(poll.poll()):
                if os.isatty(self._descriptor) and not KeyTerminal.usable(self._descriptor):
                    time.sleep(_BACKGROUND_S)  # to read now would stop the whole process: the keys are another's
                elif not self._read():
                    return
        finally:
            os.close(closing)

    def _read(self) -> bool:
        """Hand out what was typed; return whether the terminal is still there."""
        try:
            keys = os.read(self._descriptor, 4096)
        except BlockingIOError:
            return True
        except OSError:
            keys = b""
        for handler in self._handlers:
            try:
                handler(keys)
            except Exception:  # whatever it is: the emergency stop's key depends on this thread
                traceback.print_exc()
        return bool(keys)


_sources: dict[int, KeySource] = {}  # a terminal is one for the whole process, whoever reads it


def key_source(descriptor: int | None = None) -> KeySource | None:
    """Return the keys of a terminal, or None where it is none, or another process is in its foreground.

    Args:
        descriptor: of the terminal; standard input if None.
    """
    descriptor = standard_input() if descriptor is None else descriptor
    if descriptor is None or not KeyTerminal.usable(descriptor):
        return None
    return _sources.setdefault(descriptor, KeySource(descriptor))
