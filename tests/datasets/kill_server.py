"""Records in forked processes that a test may kill. Started once, so that a kill costs a fork and not an import.

Reads one JSON job per line and answers with the process id of the child, then with how it ended.
"""

import gc
import itertools
import json
import os
import signal
import sys
from pathlib import Path
from typing import Any

# Imported before the forks, because every child would import them again on its first use of Arrow.
import av  # noqa: F401
import pandas as pd  # noqa: F401
import pyarrow.dataset  # noqa: F401

from bhd_lerobot.datasets.edit import edits
from bhd_lerobot.datasets.storage import disk
from tests.datasets import support


def edit(job: dict[str, Any]) -> None:
    """Edit a dataset and die at a given step."""
    steps = itertools.count()

    def before_step(action: str, path: Path) -> None:
        if next(steps) == job["die_at"]:
            os.kill(os.getpid(), signal.SIGKILL)

    disk._before_step = before_step
    assert job["edit"] == "delete"
    edits.delete(Path(job["roots"][0]), job["episodes"])


def run(job: dict[str, Any]) -> None:
    """Do one job: save some episodes, perhaps finalise, perhaps again and again; die at a given step."""
    if "edit" in job:
        edit(job)
        return
    root, video = Path(job["root"]), job.get("video", False)
    progress = os.open(job["progress"], os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    steps = itertools.count()

    def before_step(action: str, path: Path) -> None:
        if next(steps) == job["die_at"]:
            os.kill(os.getpid(), signal.SIGKILL)

    recorder = None
    for _ in range(job.get("sessions", 1)):
        if recorder is not None or root.exists():
            recorder = support.resume(root, video=video)
        else:
            recorder = support.create(root, video=video)
        for episode in range(job["episodes"]):
            if job.get("die_at") is not None and not job["finalize"] and episode == job["episodes"] - 1:
                disk._before_step = before_step
            index = support.record(recorder, video=video)
            os.write(progress, f"saved {index}\n".encode())
        if job["finalize"]:
            if job.get("die_at") is not None:
                disk._before_step = before_step
            recorder.finalize()
            os.write(progress, b"finalized\n")


def main() -> None:
    """Serve jobs until the input ends."""
    gc.collect()
    gc.freeze()  # or a child that collects garbage copies every page
    for line in sys.stdin:
        child = os.fork()
        if child == 0:
            try:
                run(json.loads(line))
            except BaseException as error:
                print(f"child failed: {error!r}", file=sys.stderr, flush=True)
                os._exit(1)
            os._exit(0)
        print(child, flush=True)
        _, status = os.waitpid(child, 0)
        print(os.waitstatus_to_exitcode(status), flush=True)


if __name__ == "__main__":
    main()
