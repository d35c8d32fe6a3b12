"""Runs commands in forked processes, and lets something happen to them before a given change of the file system.

Started once, so that a run costs a fork and not an import. Reads one JSON job a line, and answers with the exit status
and the number of changes seen. The changes are those that Python itself reports (`sys.addaudithook`), whichever library
makes them, and the steps of `Disk` that Python does not report.
"""

import errno
import gc
import json
import os
import signal
import sys
from pathlib import Path
from typing import Any

# Imported before the forks, because every child would import them again on its first use.
import av  # noqa: F401
import mcap.writer  # noqa: F401
import pandas as pd  # noqa: F401
import pyarrow.dataset  # noqa: F401
import rosbags.rosbag2  # noqa: F401
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata  # noqa: F401

from bhd_lerobot.cli.data import main as data
from bhd_lerobot.datasets.remote import staging
from bhd_lerobot.datasets.storage import atomic, disk
from bhd_lerobot.hub import transfer  # noqa: F401
from bhd_lerobot.rosbag.messages.types import type_store
from tests.datasets import support

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
            self.change(os.fsdecode(arguments[0]), is_removal=event in REMOVALS)

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


def run(job: dict[str, Any]) -> None:
    """Do a job, and leave its exit status and the number of changes in its report."""
    os.chdir(job["cwd"])
    signal.signal(signal.SIGINT, signal.default_int_handler)
    with open(job["output"], "wb") as output:
        os.dup2(output.fileno(), 1)
        os.dup2(output.fileno(), 2)
    if job["place"] == "fixed":
        os.makedirs(job["target"], exist_ok=True)
        atomic.is_fixed = lambda place: str(place) == job["target"]
        staging.is_fixed = atomic.is_fixed
    elif job["place"] == "no exchange":

        def swap(*_: object) -> None:
            raise OSError(errno.EINVAL, os.strerror(errno.EINVAL))

        disk.Disk.swap = swap
    fault = Fault(job["watched"], job["fault"], job["step"])
    sys.addaudithook(fault.audit)
    disk._before_step = fault.before_step
    if job["argv"][0] == "record":
        status = record(Path(job["argv"][1]), int(job["argv"][2]))
    else:
        try:
            status = data.main(job["argv"])
        except SystemExit as end:
            status = int(end.code or 0)
    fault.is_on = False
    sys.stdout.flush()
    sys.stderr.flush()
    Path(job["output"] + ".steps").write_text(str(fault.steps), encoding="utf-8")
    os._exit(status)


def main() -> None:
    """Serve jobs until the input ends."""
    type_store()
    data._parser()  # imports every command
    gc.collect()
    gc.freeze()  # or a child that collects garbage copies every page
    for line in sys.stdin:
        child = os.fork()
        if child == 0:
            try:
                run(json.loads(line))
            except BaseException:
                import traceback

                traceback.print_exc()
                os._exit(99)
        _, status = os.waitpid(child, 0)
        print(os.waitstatus_to_exitcode(status), flush=True)


if __name__ == "__main__":
    main()
