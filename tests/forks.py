"""Functions in processes of their own, for tests that kill, interrupt or stop them.

They are forked from a process that has imported everything, by the standard library's fork server: a fork costs
milliseconds, an import of PyTorch and LeRobot seconds. What is said about imports, or about the first seconds of a
program, needs an interpreter of its own.
"""

import multiprocessing
import os
import pty
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, Self

from tests import shortcuts
from tests.waiting import until

_CONTEXT = multiprocessing.get_context("forkserver")


class Fork:
    """A function that runs in a process of its own, in the folder and with the environment of this one.

    Args:
        function: of a module; what it returns, or a `SystemExit` of it, is the exit status.
        arguments: what it is called with.
        output: where its output and its errors go; nowhere if None.
        terminal: its controlling terminal and standard input, in whose foreground it is; none if None.
    """

    def __init__(
        self, function: Callable[..., Any], *arguments: Any, output: Path | None = None, terminal: int | None = None
    ) -> None:
        _CONTEXT.set_forkserver_preload(["tests.preloaded"])
        if output is not None:
            output.write_bytes(b"")  # here, where it is read
        device = None if terminal is None else os.ttyname(terminal)
        self._process = _CONTEXT.Process(target=_run, args=(function, arguments, dict(os.environ), output, device))
        # The server finds this package wherever it is started: a dependency has one of the same name.
        before = os.environ.get("PYTHONPATH")
        root = str(Path(__file__).resolve().parents[1])
        os.environ["PYTHONPATH"] = root if before is None else f"{root}{os.pathsep}{before}"
        try:
            self._process.start()
        finally:
            os.environ.pop("PYTHONPATH")
            if before is not None:
                os.environ["PYTHONPATH"] = before
        assert self._process.pid is not None
        self.pid = self._process.pid

    def poll(self) -> int | None:
        """Return the exit status, the negative number of the signal that ended it, or None while it runs."""
        return self._process.exitcode

    def wait(self) -> int:
        """Wait until it ends and return what `poll` does."""
        self._process.join()
        status = self._process.exitcode
        assert status is not None
        return status

    def send_signal(self, number: int) -> None:
        """Send a signal, if it still runs."""
        if self.poll() is None:
            os.kill(self.pid, number)

    def kill(self) -> int:
        """End it at once, if it still runs, and return its exit status."""
        self._process.kill()
        return self.wait()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.kill()


class Terminal(Fork):
    """A function in the foreground of a terminal, and a person at its keys.

    Args:
        function: of a module; what it returns is the exit status.
        arguments: what it is called with.
        log: where its output and its errors go.
    """

    def __init__(self, function: Callable[..., Any], *arguments: Any, log: Path) -> None:
        self._person, device = pty.openpty()
        self._log = log
        super().__init__(function, *arguments, output=log, terminal=device)
        os.close(device)

    def text(self) -> str:
        """Return all that it has printed."""
        return self._log.read_text(encoding="utf-8")

    def expect(self, pattern: str, times: int = 1) -> None:
        """Wait until it has printed what fits a pattern, so many times."""
        until(lambda: len(re.findall(pattern, self.text())) >= times or self.poll() is not None, pattern)
        assert len(re.findall(pattern, self.text())) >= times, self.text()

    def type(self, keys: bytes) -> None:
        """Press keys."""
        os.write(self._person, keys)

    def wait(self) -> int:
        """Wait until it ends, and close the terminal."""
        if self._person >= 0:
            super().wait()
            os.close(self._person)
            self._person = -1
        return super().wait()


def _run(
    function: Callable[..., Any], arguments: tuple[Any, ...], environment: dict[str, str], output: Path | None,
    terminal: str | None,
) -> None:  # fmt: skip
    os.environ.clear()
    os.environ.update(environment)
    os.setsid()
    if terminal is not None:
        os.dup2(os.open(terminal, os.O_RDWR), 0)  # the first terminal that a session opens is its controlling one
        sys.stdin = os.fdopen(0, closefd=False)
    file = os.open(output or os.devnull, os.O_WRONLY | os.O_APPEND)
    os.dup2(file, 1)
    os.dup2(file, 2)
    shortcuts.draw(False)
    sys.exit(function(*arguments))
