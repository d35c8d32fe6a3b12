"""Commands to which something happens before a given change of the file system.

The changes are those that Python itself reports (`sys.addaudithook`), whichever library makes them, and the steps of
`Disk` that Python does not report.
"""

import errno
import os
import signal
import sys
from pathlib import Path
from typing import Any

from bhd_lerobot.cli.data import main as data
from bhd_lerobot.datasets.remote import pull
from bhd_lerobot.datasets.storage import atomic, disk
from tests.datasets import support

IS_FULL = os.environ.get("BHD_SWEEP") == "full"  # `make sweep`
REMOVALS = ("os.remove", "os.rmdir")
CHANGES = ("os.mkdir", "os.rename", "os.link", "os.symlink", "os.truncate", *REMOVALS)
WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC


class Fault:
    """Counts changes below a folder, and does something before the one with a given number."""

    def __init__(self, watched: str, kind: str, step: int) -> None:
        self.watched, self.kind, self.step, self.steps = watched, kind, step, 0
        self.is_on = True

    def audit(self, event: str, arguments: tuple[Any, ...]) -> None:
        if not self.is_on:
            return
        if event == "open":
            path, _, flags = arguments
            if not isinstance(path, str | bytes | os.PathLike) or not flags & WRITING:
                return
            self.change(os.fsdecode(path), is_removal=False)
        elif event in CHANGES:
            path = arguments[0]
            name = os.readlink(f"/proc/self/fd/{path}") if isinstance(path, int) else os.fsdecode(path)
            self.change(name, is_removal=event in REMOVALS)

    def before_step(self, action: str, path: Path) -> None:
        if action in ("write", "swap"):  # the others are seen above
            self.change(str(path), is_removal=False)

    def change(self, path: str, *, is_removal: bool) -> None:
        if os.path.isabs(path) and not path.startswith(self.watched):
            return
        self.steps += 1
        if self.steps == self.step and self.kind == "kill":
            os.kill(os.getpid(), signal.SIGKILL)
        if self.steps == self.step and self.kind == "interrupt":
            os.kill(os.getpid(), signal.SIGINT)
        # A full disk stays full, and lets files be removed.
        if self.steps >= self.step > 0 and self.kind == "full" and not is_removal:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), path)


def record(root: Path, episodes: int) -> int:
    """Record episodes, printing which are saved; go on with what is there."""
    try:
        atomic.complete_interrupted(root)  # or creating it says that it exists, and to resume it
        recorder = support.resume(root) if (root / "meta/info.json").exists() else support.create(root)
        with recorder:
            while recorder.num_episodes < episodes:
                print("saved", support.record(recorder), flush=True)
    except disk.DatasetWriteError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    return 0


def run(argv: list[str], watched: Path, counted: Path, *, place: str, target: Path, kind: str, step: int) -> int:
    """Run a command, write down how many changes were seen, and return its exit status.

    Args:
        argv: the arguments of `bhd-data`, or ``record``, a folder and a number of episodes.
        watched: the folder whose changes are counted.
        counted: where the number of changes goes.
        place: "plain", "fixed" if the target can be replaced by no other folder, "no exchange" of two names.
        target: what the command makes or changes.
        kind: "kill", "interrupt", "full", or "none".
        step: the change before which that happens.
    """
    signal.signal(signal.SIGINT, signal.default_int_handler)
    if place == "fixed":
        target.mkdir(parents=True, exist_ok=True)
        atomic.is_fixed = lambda place: Path(place) == target
        pull.is_fixed = atomic.is_fixed
    elif place == "no exchange":

        def swap(*_: object) -> None:
            raise OSError(errno.EINVAL, os.strerror(errno.EINVAL))

        disk.Disk.swap = swap
    fault = Fault(str(watched), kind, step)
    sys.addaudithook(fault.audit)
    disk._before_step = fault.before_step
    if argv[0] == "record":
        status = record(Path(argv[1]), int(argv[2]))
    else:
        try:
            status = data.main(argv)
        except SystemExit as end:
            status = int(end.code or 0)
    fault.is_on = False
    counted.write_text(str(fault.steps), encoding="utf-8")
    return status
