"""The loops that take turns: what each is called, and how to run it for some seconds."""

import json
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.realtime.statistics import Samples

ROOT = Path(__file__).resolve().parents[2]
PERIOD_NS = 1_000_000
PRIORITY = 80
WARM_UP_TICKS = 300


class CaseError(RuntimeError):
    """A case cannot be measured here; the message says why."""


@dataclass(frozen=True)
class Case:
    """A loop that can be measured.

    Attributes:
        name: short and unique, for the command line and JSON.
        title: for the tables.
        run: measures it for some seconds.
    """

    name: str
    title: str
    run: Callable[[float], Samples]


def run_program(command: Sequence[str], seconds: float) -> str:
    """Run a program that measures for some seconds; return its standard output.

    Raises:
        CaseError: it failed, or did not end.
    """
    try:
        done = subprocess.run(
            command,
            cwd=ROOT,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=60 + 3 * seconds,
            check=False,
        )
    except OSError as error:
        raise CaseError(f"{Path(command[0]).name} does not start: {error.strerror}") from error
    except subprocess.TimeoutExpired as error:
        raise CaseError(f"{Path(command[0]).name} did not end within {error.timeout:.0f} s") from error
    if done.returncode != 0:
        said = (done.stderr.strip() or done.stdout.strip() or "nothing").splitlines()[-1]
        raise CaseError(f"{Path(command[0]).name} failed with exit status {done.returncode}, saying: {said}")
    return done.stdout


def run_recorder(command: Sequence[str], out: Path, seconds: float) -> Samples:
    """Run a program that writes the records of its ticks to a file and a JSON object to its standard output.

    Raises:
        CaseError: it failed, or what it wrote is not that.
    """
    out.unlink(missing_ok=True)
    said = json.loads(run_program(command, seconds))
    if said.get("unwanted"):
        raise CaseError(f"the loop's process has imported {', '.join(said['unwanted'])}")
    records = np.fromfile(out, np.int64)
    out.unlink()
    if len(records) == 0 or len(records) % 3:
        raise CaseError(f"{Path(command[0]).name} wrote {len(records)} numbers, which are no records of ticks")
    return Samples.from_records(records.reshape(-1, 3), PERIOD_NS, said["skipped"], tuple(said["refused"]))


def ticks_in(seconds: float) -> int:
    """Return how many points the grid has in some seconds."""
    return max(1, round(seconds * 1e9 / PERIOD_NS))


def python_case(folder: Path, *, beside_busy_thread: bool) -> Case:
    """Return the plain Python loop in its own process, or the negative control.

    Args:
        folder: where it may write.
        beside_busy_thread: put a thread of pure Python into the loop's process.
    """

    def run(seconds: float) -> Samples:
        out = folder / "python.records"
        numbers = (str(n) for n in (PERIOD_NS, ticks_in(seconds), WARM_UP_TICKS, PRIORITY))
        command = [sys.executable, "-m", "benchmarks.realtime.loops", str(out), *numbers]
        return run_recorder(command + ["--beside-busy-thread"] * beside_busy_thread, out, seconds)

    if beside_busy_thread:
        return Case("thread", "Python beside a busy thread", run)
    return Case("python", "plain Python, own process", run)


def cyclictest_case() -> Case:
    """Return cyclictest, if it is installed.

    Raises:
        CaseError: it is not.
    """
    program = shutil.which("cyclictest")
    if program is None:
        raise CaseError("cyclictest is not installed (Debian and Ubuntu: package rt-tests)")

    def run(seconds: float) -> Samples:
        options = ["-q", "-m", f"-p{PRIORITY}", f"-i{PERIOD_NS // 1000}", "-t1", "-h", "20000"]
        return parse_cyclictest(run_program([program, *options, "-l", str(ticks_in(seconds))], seconds))

    return Case("cyclictest", "cyclictest", run)


def parse_cyclictest(output: str) -> Samples:
    """Return the samples of a histogram that cyclictest printed, exact to 1 µs.

    What is beyond the histogram is counted with the maximum.

    Raises:
        CaseError: there is no such histogram in the output.
    """
    latencies: list[int] = []
    overflows = highest = 0
    for line in output.splitlines():
        words = line.split()
        if len(words) == 2 and all(word.isdigit() for word in words):
            latencies += [int(words[0])] * int(words[1])
        elif line.startswith("# Histogram Overflows:"):
            overflows = int(words[-1])
        elif line.startswith("# Max Latencies:"):
            highest = int(words[-1])
    latencies += [highest] * overflows
    if not latencies:
        raise CaseError("cyclictest printed no histogram")
    return Samples(np.array(latencies, np.int64) * 1000, np.empty(0, np.int64), PERIOD_NS, 0)
