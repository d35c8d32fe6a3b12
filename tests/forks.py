"""Functions in processes of their own, for tests that kill, interrupt or stop them.

They are forked from a process that has imported everything, by the standard library's fork server: a fork costs
milliseconds, an import of PyTorch and LeRobot seconds. What is said about imports, or about the first seconds of a
program, needs an interpreter of its own.
"""

import multiprocessing
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tests import shortcuts

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
