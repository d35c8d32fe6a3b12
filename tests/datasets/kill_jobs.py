"""What processes do that a test kills: they record, and may die before a given change of the disk."""

import itertools
import os
import signal
from collections.abc import Callable
from pathlib import Path

from bhd_lerobot.datasets.storage import disk
from tests.datasets import support


def save(
    root: Path,
    progress: Path,
    episodes: int,
    *,
    finalize: bool = False,
    sessions: int = 1,
    die_at: int | None = None,
) -> None:
    """Save episodes with a camera, and perhaps finalise, in some sessions; write down what is done.

    With `die_at`, die in the last episode, or while finalising, before the change of the disk with this number.
    """
    done = os.open(progress, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    recorder = None
    for _ in range(sessions):
        make = support.resume if recorder is not None or root.exists() else support.create
        recorder = make(root, video=True)
        for episode in range(episodes):
            if die_at is not None and not finalize and episode == episodes - 1:
                disk._before_step = _dying(die_at)
            index = support.record(recorder, video=True)
            os.write(done, f"saved {index}\n".encode())
        if finalize:
            if die_at is not None:
                disk._before_step = _dying(die_at)
            recorder.finalize()
            os.write(done, b"finalized\n")


def _dying(die_at: int) -> Callable[[str, Path], None]:
    steps = itertools.count()

    def before_step(action: str, path: Path) -> None:
        if next(steps) == die_at:
            os.kill(os.getpid(), signal.SIGKILL)

    return before_step
