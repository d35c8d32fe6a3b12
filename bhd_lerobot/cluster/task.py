"""Episodes on their way through a cluster: who has them, and their outcome."""

import pickle
from collections import deque
from dataclasses import dataclass, field
from typing import Any

from bhd_lerobot.errors import BhdError

Spec = tuple[int, int]  # an episode's number and seed


@dataclass(order=True)
class Task:
    """Some episodes for one worker.

    Attributes:
        number: its place in the run.
        specs: the episodes.
        is_suspect: a worker that had it was lost, so that it runs alone from then on: the result of an earlier task
            may be lost with its worker, and nobody could say which one of several was running.
        deaths: how many workers were lost that had nothing else.
    """

    number: int
    specs: list[Spec] = field(compare=False)
    is_suspect: bool = field(default=False, compare=False)
    deaths: int = field(default=0, compare=False)

    def __str__(self) -> str:
        """The episodes as text."""
        first, last = self.specs[0][0], self.specs[-1][0]
        return f"episode {first}" if first == last else f"episodes {first} to {last}"


@dataclass(eq=False)
class Worker:
    """A process of the cluster.

    Attributes:
        is_there: whether it has been given a machine, and answered.
        job: the job that it is ready for, as Ray's reference, or None.
        tasks: what it was given and has not finished, the running one first.
    """

    actor: Any
    host: str = "a machine that had not answered yet"
    is_there: bool = False
    job: Any = None
    tasks: deque[Task] = field(default_factory=deque)

    @property
    def is_ready(self) -> bool:
        """Whether it can be given tasks."""
        return self.job is not None


@dataclass(frozen=True)
class Call:
    """A call that a worker has not answered yet.

    Attributes:
        worker: the worker.
        kind: `describe`, `prepare` or `run`.
        task: what is run.
    """

    worker: Worker
    kind: str
    task: Task | None = None


def error_of(failure: dict[str, Any], where: str) -> BaseException:
    """Return what a worker raised, with where that was."""
    error: BaseException = pickle.loads(failure["error"])
    error.add_note(where)
    if not isinstance(error, BhdError):
        error.add_note(f"There:\n{failure['traceback']}")
    return error


def cause_of(error: BaseException) -> str:
    """Return the first sentence or two of what Ray says."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip() and "class_name" not in line]
    text = " ".join(lines)
    return text if len(text) <= 300 else text[:300] + "…"
