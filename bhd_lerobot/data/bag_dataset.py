"""A dataset that is made of bags: all of it, or nothing."""

import contextlib
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from bhd_lerobot.data.recorder import DatasetRecorder


@dataclass
class ImportReport:
    """What was made of bags.

    Attributes:
        root: the dataset.
        episodes, frames: how many.
        problems: what was wrong with the bags, in sentences.
        notes: what was done that somebody should know, in sentences.
    """

    root: Path
    episodes: int = 0
    frames: int = 0
    problems: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


@contextlib.contextmanager
def all_or_nothing(root: Path) -> Iterator[Callable[[DatasetRecorder], DatasetRecorder]]:
    """Finalise the dataset that is made inside the block; after an exception remove it.

    Gives a function to be told of the recorder once it is created.
    """
    recorders: list[DatasetRecorder] = []

    def made(recorder: DatasetRecorder) -> DatasetRecorder:
        recorders.append(recorder)
        return recorder

    try:
        yield made
        for recorder in recorders:
            recorder.finalize()
    except BaseException:
        for recorder in recorders:
            with contextlib.suppress(Exception):
                recorder.finalize()  # gives the lock back
            shutil.rmtree(root, ignore_errors=True)
        raise
