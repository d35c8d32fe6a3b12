"""How a command begins: from its first moment on, Ctrl-C is a line and status 130; how it uses threads and memory.

What a command needs takes seconds to import. An interrupt in the middle of that is a traceback, or is swallowed by a
library that catches everything; so this module imports next to nothing, and ends the process itself meanwhile.
"""

import ctypes
import importlib
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from types import FrameType

from bhd_lerobot import __version__
from bhd_lerobot.options.command import INTERRUPTED, exit_status
from bhd_lerobot.stock import defer_packages
from bhd_lerobot.versions import check_version

_WITHOUT_LEROBOT = ("bhd_lerobot.cli.doctor", "bhd_lerobot.cli.monitor")
_WITH_ESTOP = ("bhd_lerobot.cli.record", "bhd_lerobot.cli.evaluate", "bhd_lerobot.cli.replay")


@contextmanager
def leaving_on_interrupt() -> Iterator[None]:
    """End the process at Ctrl-C, with a line and status 130; for imports, when there is nothing to be lost yet.

    Nothing is done where Ctrl-C is ignored, as of a command in the background of a script, or has another handler.
    """
    if signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield
        return
    try:
        signal.signal(signal.SIGINT, _leave)
    except ValueError:  # not the main thread, which is the one that is interrupted
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@contextmanager
def loading() -> Iterator[None]:
    """Load what a command needs: a terminal shows that it has begun, and Ctrl-C ends it, see `leaving_on_interrupt`."""
    is_shown = sys.stderr is not None and sys.stderr.isatty()
    if is_shown:
        print("Loading…", end="\r", file=sys.stderr, flush=True)
    try:
        with leaving_on_interrupt():
            yield
    finally:
        if is_shown:
            print("\x1b[K", end="", file=sys.stderr, flush=True)


def _leave(number: int, frame: FrameType | None) -> None:
    os.write(2, b"Stopped before it began; nothing was changed.\n")
    os._exit(INTERRUPTED)


def run(module: str) -> int:
    """Import a module and run its `main`; return the exit status. The process is to end then."""
    # PyTorch's threads wait for each other after every operation, by default in a loop that keeps a processor busy.
    # Where other programs run as well, that takes the processor from the thread that is waited for: with two threads
    # on two processors, beside four busy processes, a training made a fiftieth of its steps. Asleep they compute the
    # same bits. OpenMP reads this once, when PyTorch is imported.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    if sys.argv[1:] == ["--version"]:
        print(f"lerobot_robot_bhd {__version__}")
        return 0

    if module in _WITH_ESTOP:  # signals of an emergency stop wait for what handles them, and end nothing
        signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGUSR1, signal.SIGUSR2])

    def program() -> int | None:
        with loading():
            if module not in _WITHOUT_LEROBOT:
                check_version("lerobot")
                defer_packages()
            main = importlib.import_module(module).main
        return main()

    try:
        return exit_status(program)
    finally:
        if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            signal.signal(signal.SIGINT, signal.SIG_DFL)  # what libraries do at the very end is no traceback either


def keep_memory() -> None:
    """Let this process keep the memory that it frees, where the C library has a way to say so.

    Numbers for a batch of images take a hundred megabytes. To have them from the system anew in every step, page by
    page, takes longer than to compute with a small network.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_MMAP_MAX, 0)
        mallopt(_TRIM_THRESHOLD, -1)


_TRIM_THRESHOLD, _MMAP_MAX = -1, -4  # options of mallopt(3), by their numbers in malloc.h


record = partial(run, "bhd_lerobot.cli.record")
train = partial(run, "bhd_lerobot.cli.train")
evaluate = partial(run, "bhd_lerobot.cli.evaluate")
replay = partial(run, "bhd_lerobot.cli.replay")
data = partial(run, "bhd_lerobot.cli.data.main")
doctor = partial(run, "bhd_lerobot.cli.doctor")
monitor = partial(run, "bhd_lerobot.cli.monitor")
ros2 = partial(run, "bhd_lerobot.cli.ros2")
