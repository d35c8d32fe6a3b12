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
from collections.abc import Callable, Iterator
from typing import Any

KeyHandler = Callable[[bytes], None]
"""What gets keys as the terminal sends them; b"" when the terminal is gone. It must not block."""

_ROUND_S = 0.2  # [s] between two looks whether the terminal is as it was taken
_BACKGROUND_S = 0.05  # [s] between two looks whether the terminal is this process's again
_BY_LINES = termios.ICANON | termios.ECHO  # keys come with Enter, and are shown


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
        self._lock = threading.Lock()
        self._former: list[Any] | None = termios.tcgetattr(descriptor)
        self._taken = termios.tcgetattr(descriptor)
        self._taken[3] &= ~_BY_LINES
        self._taken[6][termios.VMIN], self._taken[6][termios.VTIME] = 1, 0
        atexit.register(self.restore)
        termios.tcsetattr(descriptor, termios.TCSADRAIN, self._taken)

    def keep(self) -> None:
        """Take the terminal again if a shell has had it, which after Ctrl-Z gives it back as it was before."""
        with self._lock, contextlib.suppress(termios.error):
            if self._former is not None and termios.tcgetattr(self.descriptor)[3] & _BY_LINES:
                termios.tcsetattr(self.descriptor, termios.TCSANOW, self._taken)

    @staticmethod
    def usable(descriptor: int | None) -> bool:
        """Return whether this is a terminal, and this process may use it without being stopped for it."""
        try:
            return descriptor is not None and os.isatty(descriptor) and os.tcgetpgrp(descriptor) == os.getpgrp()
        except OSError:
            return False

    def restore(self) -> None:
        """Put the terminal back to what it was. May be called twice."""
        with self._lock:
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
            self._open()

    def unsubscribe(self, handler: KeyHandler) -> None:
        """Call a handler no more. May be called twice."""
        with self._lock:
            self._handlers = tuple(one for one in self._handlers if one != handler)
            thread = None if self._handlers else self._close()
        _join(thread)

    @contextlib.contextmanager
    def lent(self) -> Iterator[None]:
        """Give the terminal back meanwhile, to whoever asks a person in it; what they leave unread comes afterwards."""
        with self._lock:
            thread = self._close()
        _join(thread)
        try:
            yield
        finally:
            with self._lock:
                if self._handlers and KeyTerminal.usable(self._descriptor):
                    self._open()

    def _open(self) -> None:
        if self._opened is None:
            terminal = KeyTerminal(self._descriptor)
            reader, writer = os.pipe()
            thread = threading.Thread(target=self._work, args=(terminal, reader), name="bhd-keys", daemon=True)
            self._opened = terminal, thread, writer
            thread.start()

    def _close(self) -> threading.Thread | None:
        """Give the terminal back; return the thread, which ends."""
        if self._opened is None:
            return None
        (terminal, thread, writer), self._opened = self._opened, None
        os.close(writer)
        terminal.restore()
        return thread

    def _work(self, terminal: KeyTerminal, closing: int) -> None:
        poll = select.poll()
        poll.register(self._descriptor, select.POLLIN)
        poll.register(closing, select.POLLIN)
        try:
            while closing not in (events := dict(poll.poll(1000 * _ROUND_S))):
                if os.isatty(self._descriptor) and not KeyTerminal.usable(self._descriptor):
                    time.sleep(_BACKGROUND_S)  # to read now would stop the whole process: the keys are another's
                    continue
                terminal.keep()
                if self._descriptor in events and not self._read():
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


def _join(thread: threading.Thread | None) -> None:
    if thread is not None and thread is not threading.current_thread():
        thread.join(1.0)


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
