"""Marks of a person while an episode is recorded: success, failure, intervention."""

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.errors import ConfigError, unknown_name
from bhd_lerobot.tasks.task import OUTCOMES, Event

Mask = NDArray[np.bool_]


class MarkKey(NamedTuple):
    """A key of the terminal that marks the running episode.

    Attributes:
        name: what is printed on the key.
        sent: what the terminal sends for it, each byte alone.
        meaning: ``"success"``, ``"failure"``, ``"intervention"``, ``"again"`` or ``"pause"``.
    """

    name: str
    sent: bytes
    meaning: str


KEYS = (
    MarkKey("s", b"sS", "success"),
    MarkKey("f", b"fF", "failure"),
    MarkKey("i", b"iI", "intervention"),
    MarkKey("r", b"rR", "again"),
    MarkKey("p", b"pP", "pause"),
)
"""The keys of the terminal."""
TELEOP_KEYS = (
    MarkKey("Enter", b"\r\n", "success"),
    MarkKey("Backspace", b"\x7f\b", "failure"),
    MarkKey("Tab", b"\t", "intervention"),
    MarkKey("t", b"tT", "again"),
    MarkKey("p", b"pP", "pause"),
)
"""The keys while a keyboard teleoperator uses the other letters."""
_MEANINGS = {
    "success": "success",
    "failure": "failure",
    "intervention": "intervention begins or ends",
    "again": "discards this take and records it again",
    "pause": "pauses before the next episode",
}


def key_help(keys: Sequence[MarkKey]) -> str:
    """Return in one line what the keys mean."""
    return ", ".join(f"{key.name} {_MEANINGS[key.meaning]}" for key in keys)


_HELD_S = 0.7  # so long an Enter that began an episode may repeat itself without ending it
_HARD = (Event.ESTOP, Event.FAULT)  # they take precedence over a person's mark in the same frame


class Marks:
    """Takes marks from any thread and hands them to the recording loop, frame by frame.

    An outcome ends the episode with the frame in which it is set. A frame of an intervention carries the
    event ``intervention``; what moves the robot meanwhile is not decided here.

    Args:
        n: number of simulations.
        outcomes: those that the task can have.
        keys: the terminal's keys: `KEYS`, or `TELEOP_KEYS` while a keyboard teleoperator uses the letters.
        hands_over: whether an intervention hands the robot over to a person: then the brain says in which frames they
            drove, which are not those of the key where an action takes its time.
    """

    def __init__(
        self,
        n: int = 1,
        outcomes: Sequence[str] = OUTCOMES,
        keys: Sequence[MarkKey] = KEYS,
        *,
        hands_over: bool = False,
    ) -> None:
        self._n, self._valid, self._keys, self._hands_over = n, tuple(outcomes), tuple(keys), hands_over
        self._lock = threading.Lock()
        self._outcomes: dict[int, Event] = {}
        self._driving: set[int] = set()
        self._again = self._is_paused = False
        self._is_waiting, self._go = False, threading.Event()
        self._until = 0.0  # Enter means nothing before this time

    def outcome(self, name: str, simulation: int = 0) -> None:
        """Mark that the running episode of a simulation ends now, and how: by one of the outcomes."""
        if name not in self._valid:
            raise ConfigError(unknown_name("outcome", name, self._valid))
        with self._lock:
            self._outcomes[self._checked(simulation)] = Event[name.upper()]

    def intervention(self, is_on: bool | None = None, simulation: int = 0) -> None:
        """Mark that an intervention begins now, or ends; the other one if None."""
        with self._lock:
            if (self._checked(simulation) not in self._driving) if is_on is None else is_on:
                self._driving.add(simulation)
            else:
                self._driving.discard(simulation)

    def is_driving(self, simulation: int = 0) -> bool:
        """Return whether an intervention is on in a simulation."""
        with self._lock:
            return simulation in self._driving

    def again(self) -> None:
        """Discard the running take of the first simulation, and record it again."""
        with self._lock:
            self._again = True

    def take_again(self) -> bool:
        """Return whether the running take is to be discarded; then it is forgotten."""
        with self._lock:
            again, self._again = self._again, False
        return again

    def pause(self) -> None:
        """Wait for a person before the next episode, or no longer."""
        with self._lock:
            self._is_paused = not self._is_paused

    @contextmanager
    def waiting(self) -> Iterator[Callable[[], bool]]:
        """Let Enter mean that the next episode begins; yield what returns whether it was pressed."""
        with self._lock:
            self._go.clear()
            self._is_waiting = True
        try:
            yield self._go.is_set
        finally:
            with self._lock:
                self._is_waiting = self._is_paused = False
                self._until = time.monotonic() + _HELD_S

    @property
    def is_paused(self) -> bool:
        """Whether the next episode waits for a person."""
        return self._is_paused

    def on_key(self, keys: bytes) -> None:
        """Take keys of a terminal. They mean the first simulation."""
        marks = {"intervention": self.intervention, "again": self.again, "pause": self.pause}
        for key in keys:
            if self._is_waiting and key in b"\r\n":
                self._go.set()
                continue
            if key in b"\r\n" and time.monotonic() < self._until:
                continue
            for meaning in [one.meaning for one in self._keys if key in one.sent]:
                marks[meaning]() if meaning in marks else self.outcome(meaning)

    def begin(self, simulations: NDArray[np.intp]) -> None:
        """Forget the marks of episodes before."""
        with self._lock:
            for simulation in simulations.tolist():
                self._outcomes.pop(simulation, None)
                self._driving.discard(simulation)
            self._again = False

    def frame(self, event: NDArray[np.int64], running: Mask) -> tuple[NDArray[np.int64], Mask]:
        """Return a frame's events with the marks applied, and where interventions are on, both of shape (n,)."""
        driven = np.zeros(self._n, np.bool_)
        with self._lock:
            if not self._outcomes and not self._driving:
                return event, driven
            driven[list(self._driving)] = not self._hands_over
            marked = event.copy()
            for simulation in [sim for sim in self._outcomes if running[sim]]:
                outcome = self._outcomes.pop(simulation)
                if marked[simulation] not in _HARD:
                    marked[simulation] = outcome
        return marked, driven & running

    def _checked(self, simulation: int) -> int:
        if not 0 <= simulation < self._n:
            raise ConfigError(f"There is no simulation {simulation}; valid: 0 to {self._n - 1}.")
        return simulation
