"""Robots that are measured: each is owned by a process of its own, and watched from here through its shared memory."""

import json
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from benchmarks.realtime.cases import ROOT, WARM_UP_TICKS, Case, CaseError
from benchmarks.realtime.owner import OwnerSpec, as_argument
from benchmarks.realtime.stamps import StampError, block_samples
from benchmarks.realtime.statistics import Samples
from benchmarks.realtime.watcher import Watcher
from bhd_lerobot.control.messages import NANOSECONDS
from bhd_lerobot.realtime.block import Word
from bhd_lerobot.realtime.shared_memory import FOLDER, PREFIX

_START_S = 180.0
_END_S = 20.0
_DRAIN_S = 0.1  # between two looks into the ring, which holds seconds


class OwnedRobot:
    """A robot, the process that owns it, and a `Watcher`.

    Attributes:
        spec: what the owner runs.
        watcher: reads its states.
        pids: numbers of the robot's processes, by name.
        about: what the owner said about it.

    Use `owned_robot`, which ends it whatever happens.
    """

    def __init__(self, spec: OwnerSpec) -> None:
        self.spec = spec
        self.pids: dict[str, int] = {}
        self.about: dict[str, Any] = {}
        self._watcher: Watcher | None = None
        self._rest = b""
        # Unbuffered: `select` must see all that was not read yet.
        self.process = subprocess.Popen(
            [sys.executable, "-m", "benchmarks.realtime.owner", as_argument(spec), str(os.getpid())],
            cwd=ROOT,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            bufsize=0,
        )

    def prepare(self) -> None:
        """Wait until the robot is ready.

        Raises:
            CaseError: it cannot be started.
        """
        if self._watcher is not None:
            return
        self.about = self.expect("ready", _START_S)
        self.pids = dict(self.about["pids"])
        if self.about["heavy"]:
            raise CaseError(f"the loop's process has imported {', '.join(self.about['heavy'])}")
        self._watcher = Watcher(self.spec.name)

    @property
    def watcher(self) -> Watcher:
        """What reads the robot's states."""
        if self._watcher is None:
            raise CaseError(f"{self.spec.name} is not ready")
        return self._watcher

    @property
    def notes(self) -> tuple[str, ...]:
        """What the system refused to the loop."""
        return tuple(self.about["refused"])

    def tell(self, line: str) -> None:
        """Write a line to the owner.

        Raises:
            CaseError: it has ended.
        """
        assert self.process.stdin is not None
        try:
            self.process.stdin.write(line.encode() + b"\n")
        except (OSError, ValueError):  # the pipe is broken, or closed
            raise CaseError(f"the process that owns {self.spec.name} has ended") from None

    def hear(self, seconds: float) -> dict[str, Any] | None:
        """Return what the owner says next, or None if it says nothing in time.

        Raises:
            CaseError: it failed, or has ended.
        """
        assert self.process.stdout is not None
        until = time.monotonic() + seconds
        while b"\n" not in self._rest:
            left = until - time.monotonic()
            if not select.select([self.process.stdout], [], [], max(0.0, left))[0]:
                return None
            got = self.process.stdout.read(4096)
            if not got:
                raise CaseError(f"the process that owns {self.spec.name} has ended ({self.process.wait(_END_S)})")
            self._rest += got
        line, _, self._rest = self._rest.partition(b"\n")
        try:
            said: dict[str, Any] = json.loads(line)
        except ValueError:
            raise CaseError(f"the process that owns {self.spec.name} said {line[:200]!r}") from None
        if said["event"] == "failed":
            raise CaseError(f"{self.spec.name}: {said['message']}")
        return said

    def expect(self, event: str, seconds: float, meanwhile: Callable[[], object] = lambda: None) -> dict[str, Any]:
        """Wait for an event; read the ring while waiting.

        Raises:
            CaseError: it does not come in time, or another one comes.
        """
        until = time.monotonic() + seconds
        while time.monotonic() < until:
            said = self.hear(_DRAIN_S)
            meanwhile()
            if said is not None:
                if said["event"] != event:
                    raise CaseError(f"the owner of {self.spec.name} said {said['event']}, not {event}")
                return said
        raise CaseError(f"the owner of {self.spec.name} did not say {event!r} within {seconds:g} s")

    def run(self, seconds: float) -> None:
        """Begin a stretch of some seconds; returns when it has begun."""
        watcher = self.watcher
        watcher.begin()
        self.tell(f"run {seconds}")
        self.expect("started", 60.0, watcher.drain)

    def finish(self, seconds: float) -> dict[str, Any]:
        """Wait for the end of a stretch, reading its states; return what the owner says about it."""
        said = self.expect("done", 60.0 + 3 * seconds, self.watcher.drain)
        self.watcher.drain()
        return said

    def pause(self) -> None:
        """End a stretch of setpoints before its time."""
        self.tell("pause")
        self.finish(1.0)

    def samples(self, warm_up: int = WARM_UP_TICKS) -> Samples:
        """Return the ticks of the stretch that has ended.

        Raises:
            CaseError: a state was lost: what was measured is not what happened.
        """
        watcher = self.watcher
        try:
            records = watcher.records()
            # What the loop's warm-up published, before its first stretch, is not of this one.
            records = records[records["stretch"] == watcher.words[Word.STRETCH]]
            return block_samples(records, watcher.period_ns, watcher.drops, warm_up, self.notes)
        except StampError as error:
            raise CaseError(str(error)) from error

    def sleep(self) -> None:
        """Let the owner stand still while others are measured: its threads would disturb them."""
        if self.process.poll() is None:
            os.kill(self.process.pid, signal.SIGSTOP)

    def wake(self) -> None:
        """Undo `sleep`."""
        if self.process.poll() is None:
            os.kill(self.process.pid, signal.SIGCONT)

    def leftovers(self, seconds: float) -> list[str]:
        """Return what is left of a robot whose owner has ended: its processes, its memory; waits for them to go."""
        if self._watcher is not None:
            self._watcher.close()
            self._watcher = None
        until = time.monotonic() + seconds
        while True:
            left = [f"{name} ({pid})" for name, pid in self.pids.items() if is_running(pid)]
            # What its last user left behind is removed by whoever comes next; what somebody holds is not.
            left += map(str, FOLDER.glob(f"{PREFIX}{self.spec.name}.*"))
            if not left or time.monotonic() > until:
                return left
            time.sleep(0.05)

    def close(self, *, at_once: bool = False) -> list[str]:
        """End the robot and all of its processes; return what is left of it, which should be nothing.

        Args:
            at_once: not at the end of what its owner does now, its start for example.
        """
        process = self.process
        self.wake()
        if at_once:
            process.terminate()
        for stream in (process.stdin, process.stdout):
            if stream is not None:
                with suppress(OSError):
                    stream.close()
        try:
            process.wait(_END_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        left = self.leftovers(10.0)
        for pid in self.pids.values():
            if is_running(pid):
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
        return left


@contextmanager
def standing_still(pid: int) -> Iterator[None]:
    """Let a process stand still.

    A child does it that lets the process go on as soon as its standard input ends, which it does with this process
    however that dies: no process of a robot stands still for ever.
    """
    script = 'kill -STOP "$0" && echo stopped && read -r _; kill -CONT "$0"'
    with subprocess.Popen(["/bin/sh", "-c", script, str(pid)], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as child:
        assert child.stdout is not None
        if child.stdout.readline() != b"stopped\n":
            raise CaseError(f"process {pid} could not be stopped")
        yield
        # The end of the block closes its input.


def is_running(pid: int) -> bool:
    """Return whether a process exists that has not ended; one that only waits to be asked for its status has."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text(encoding="ascii", errors="replace").rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state not in "ZX"


@contextmanager
def owned_robot(spec: OwnerSpec) -> Iterator[OwnedRobot]:
    """Yield a robot, which may not be ready yet, and end it.

    Raises:
        CaseError: something was left behind that should not be.
    """
    robot = OwnedRobot(spec)
    try:
        yield robot
    except BaseException:
        robot.close(at_once=True)
        raise
    left = robot.close()
    if left:
        raise CaseError(f"{spec.name} left behind: {', '.join(left)}")


def robot_case(
    name: str,
    title: str,
    robot: OwnedRobot,
    *,
    reports: list[dict[str, Any]],
    stop: str = "",
) -> Case:
    """Return the loop of a robot as a case.

    Args:
        name: of the case.
        title: of the case.
        robot: the robot; it sleeps between its turns.
        reports: gets what the owner says of each stretch, with ``count_error`` of the loop.
        stop: name of the process that stands still meanwhile; none if empty.
    """

    def run(seconds: float) -> Samples:
        robot.wake()
        try:
            warm_up_s = WARM_UP_TICKS * robot.watcher.period_ns / NANOSECONDS
            seconds += warm_up_s
            robot.run(seconds)
            if stop:
                time.sleep(warm_up_s / 2)
                with standing_still(robot.pids[stop]):
                    said = robot.finish(seconds)
            else:
                said = robot.finish(seconds)
            samples = robot.samples()
        finally:
            robot.sleep()
        reports.append({**said, "case": name, "count_error": samples.count_error})
        return samples

    return Case(name, title, run)
