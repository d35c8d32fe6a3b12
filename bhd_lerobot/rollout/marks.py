"""Marks of a person while an episode is recorded: success, failure, intervention."""

import math
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
    """A key of the terminal that marks the running episode; of `sent`, what the terminal sends, each byte alone."""

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
    "again": "discards this take, or between two the last, and records it again",
    "pause": "pauses before the next episode",
}


def key_help(keys: Sequence[MarkKey]) -> str:
    """Return in one line what the keys mean."""
    return ", ".join(f"{key.name} {_MEANINGS[key.meaning]}" for key in keys)


_HELD_S = 0.7  # a key that comes again within this time is held: terminals repeat it first after 0.25 to 0.66 s
_HARD = (Event.ESTOP, Event.FAULT)  # they take precedence over a person's mark in the same frame


class Marks:
    """Takes marks from any thread and hands them to the recording loop, frame by frame.

    An outcome ends the episode with the frame in which it is set. A frame of an intervention carries the
    event ``intervention``; what moves the robot meanwhile is not decided here. A key that is held is one key.

    Attributes:
        answer: gets what each key does, or why it does nothing, as text, from the thread of the keys; must not block.

    Args:
        n: number of simulations.
        outcomes: those that the task can have.
        keys: the terminal's keys: `KEYS`, or `TELEOP_KEYS` while a keyboard teleoperator uses the letters.
        hands_over: whether an intervention hands the robot over to a person: then the brain says in which frames they
            drove, which are not those of the key where an action takes its time.
        shortest_s: an episode that a key ends lasts at least so long [s].
        clock: monotonic time [s].
    """

    def __init__(
        self,
        n: int = 1,
        outcomes: Sequence[str] = OUTCOMES,
        keys: Sequence[MarkKey] = KEYS,
        *,
        hands_over: bool = False,
        shortest_s: float = 0.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.answer: Callable[[str], None] = lambda text: None
        self._n, self._valid, self._keys, self._hands_over = n, tuple(outcomes), tuple(keys), hands_over
        self._lock, self._clock, self._shortest_s = threading.Lock(), clock, shortest_s
        self._outcomes: dict[int, Event] = {}
        self._driving: set[int] = set()
        self._again = self._is_paused = False
        self._is_waiting, self._has_last, self._go = False, False, threading.Event()
        self._closed = ""  # why keys mean nothing now
        self._began_s = -math.inf
        self._last: tuple[int, float] = -1, -math.inf  # the last key, and when it came

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
    def waiting(self, *, has_last: bool = False) -> Iterator[Callable[[], bool]]:
        """Let Enter mean that the next episode begins; yield what returns whether it was pressed."""
        with self._lock:
            self._go.clear()
            self._is_waiting, self._has_last, self._again = True, has_last, False
        try:
            yield self._go.is_set
        finally:
            with self._lock:
                self._is_waiting = self._is_paused = False

    @property
    def is_paused(self) -> bool:
        """Whether the next episode waits for a person."""
        return self._is_paused

    def close(self, why: str) -> None:
        """Let keys mean nothing until the next episode begins, and answer them why."""
        self._closed = why

    def on_key(self, keys: bytes) -> None:
        """Take keys of a terminal. They mean the first simulation."""
        for key in keys:
            (last, last_s), now = self._last, self._clock()
            if key == last and now - last_s <= _HELD_S:
                self._last = key, now
                continue
            counts, answer = self._take_key(key, now - self._began_s)
            self._last = key if counts else -1, now
            if answer:
                self.answer(answer)

    def _take_key(self, key: int, age_s: float) -> tuple[bool, str]:
        """Return whether a key counts at this age of the episode, and the answer; do what it means."""
        if self._is_waiting and key in b"\r\n":
            self._go.set()
            return True, "Enter: the next take begins"
        found = next((one for one in self._keys if key in one.sent), None)
        if found is None:  # of somebody else, such as a keyboard teleoperator
            is_ours = self._keys is KEYS and key > 32
            return False, f"{chr(key)} means nothing here: {key_help(self._keys)}" if is_ours else ""
        if refusal := self._refusal(found.meaning, age_s):
            return False, f"{found.name} counts for nothing: {refusal}"
        return True, f"{found.name}: {self._do(found.meaning)}"

    def _refusal(self, meaning: str, age_s: float) -> str:
        if self._is_waiting:
            if meaning == "again":
                return "" if self._has_last and not self._again else "there is no take to discard"
            return "" if meaning == "pause" else "no take runs"
        if meaning in ("success", "failure") and age_s < self._shortest_s and not self._closed:
            return f"a take has at least {self._shortest_s:g} s"
        return self._closed

    def _do(self, meaning: str) -> str:
        match meaning:
            case "pause" if self._is_waiting:
                self._is_paused = True
                return "pause, Enter begins the next take"
            case "pause":
                self.pause()
                return f"{'a' if self._is_paused else 'no'} pause comes after this take"
            case "again":
                self.again()
                return f"{'the last take is discarded' if self._is_waiting else 'discarded'} and recorded again"
            case "intervention":
                self.intervention()
                return f"an intervention {'begins' if self.is_driving() else 'ends'}"
            case _:
                self.outcome(meaning)
                return meaning

    def begin(self, simulations: NDArray[np.intp]) -> None:
        """Forget the marks of episodes before."""
        self._closed, self._began_s = "", self._clock()
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
