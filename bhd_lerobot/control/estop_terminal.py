"""Single keys from a terminal, without breaking Ctrl-C, and with the terminal as it was at the end."""

import atexit
import contextlib
import os
import sys
import termios
from typing import Any


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
