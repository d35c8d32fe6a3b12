"""CPU load on every core: one busy child for each, at the ordinary scheduling policy.

A child ends with the block that asked for it, with its parent however that dies, and in any case when its time is up.
As a program, `python -m benchmarks.realtime.load CPU SECONDS PARENT`, it is one such child.
"""

import ctypes
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

_ROOT = Path(__file__).resolve().parents[2]
_PR_SET_PDEATHSIG = 1


class LoadError(RuntimeError):
    """The load did not run as it was asked to."""


@dataclass
class Load:
    """What a load did, known when it has ended.

    Attributes:
        cores: cores that it kept busy.
        share: processor time it got, of all that these cores have; None while it runs.
    """

    cores: int
    share: float | None = None


@contextmanager
def cpu_load(max_seconds: float) -> Iterator[Load]:
    """Keep every core that this process may use busy.

    Args:
        max_seconds: after this time the load ends by itself [s].

    Raises:
        LoadError: a child did not start, or ended before its time.
    """
    cores = sorted(os.sched_getaffinity(0))
    load = Load(len(cores))
    with ExitStack() as stack:
        children = [stack.enter_context(_child(core, max_seconds)) for core in cores]
        for child in children:
            assert child.stdout is not None
            if child.stdout.readline() != b"busy\n":
                raise LoadError(f"The load on {len(cores)} cores did not start (exit status {child.wait()}).")
        started, used = time.monotonic(), [_cpu_seconds(child.pid) for child in children]
        yield load
        ended = [child.poll() for child in children]
        if any(status is not None for status in ended):
            raise LoadError(f"The load ended before its time (exit statuses {ended}, at most {max_seconds:g} s).")
        seconds = sum(_cpu_seconds(child.pid) - before for child, before in zip(children, used, strict=True))
        load.share = seconds / (len(cores) * (time.monotonic() - started))


@contextmanager
def _child(core: int, max_seconds: float) -> Iterator[subprocess.Popen[bytes]]:
    command = [sys.executable, "-m", "benchmarks.realtime.load", str(core), str(max_seconds), str(os.getpid())]
    with subprocess.Popen(command, cwd=_ROOT, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE) as child:
        try:
            yield child
        finally:
            child.kill()


def _cpu_seconds(pid: int) -> float:
    """Return the processor time that a process has used [s]."""
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii", errors="replace").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _busy(core: int, seconds: float, parent: int) -> int:
    until = time.monotonic() + seconds
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != parent:  # it died before it could have told the kernel to kill this process
        return 1
    os.sched_setaffinity(0, {core})
    print("busy", flush=True)
    value = 1
    while time.monotonic() < until:
        for _ in range(20_000):
            value = value * 1_103_515_245 + 12_345 & 0x7FFFFFFF
    return 0


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    sys.exit(_busy(int(sys.argv[1]), float(sys.argv[2]), int(sys.argv[3])))
