"""What a person says while an episode is recorded: it succeeded, it failed, somebody intervenes."""

import threading
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.errors import ConfigError, unknown_name
from bhd_lerobot.tasks.task import OUTCOMES, Event

Mask = NDArray[np.bool_]

KEYS = "s success, f failure, i intervention begins or ends"
"""What each key of the terminal says."""

_HARD = (Event.ESTOP, Event.FAULT)  # what the robot did is true, whatever a person says in the same frame


class Marks:
    """Takes marks from any thread and hands them to the recording loop, frame by frame.

    An outcome ends the episode with the frame in which it is said. A frame in which somebody intervenes carries the
    event ``intervention``; what moves the robot meanwhile is not decided here.

    Args:
        n: number of simulations.
        outcomes: what an episode can end with; see `bhd_lerobot.tasks.task.outcomes_of`.
    """

    def __init__(self, n: int = 1, outcomes: Sequence[str] = OUTCOMES) -> None:
        self._n, self._valid = n, tuple(outcomes)
        self._lock = threading.Lock()
        self._outcomes: dict[int, Event] = {}
        self._driving: set[int] = set()

    def outcome(self, name: str, simulation: int = 0) -> None:
        """Say that the running episode ends now, and how.

        Args:
            name: one of `outcomes`, for example ``success``, ``failure`` or ``collision``.
            simulation: whose episode.

        Raises:
            ConfigError: there is no such outcome or simulation.
        """
        if name not in self._valid:
            raise ConfigError(unknown_name("outcome", name, self._valid))
        with self._lock:
            self._outcomes[self._checked(simulation)] = Event[name.upper()]

    def intervention(self, is_on: bool | None = None, simulation: int = 0) -> None:
        """Say that somebody intervenes from now on, or no longer.

        Args:
            is_on: whether somebody does; the contrary of what was so if None.
            simulation: in whose episode.

        Raises:
            ConfigError: there is no such simulation.
        """
        with self._lock:
            if (self._checked(simulation) not in self._driving) if is_on is None else is_on:
                self._driving.add(simulation)
            else:
                self._driving.discard(simulation)

    def on_key(self, keys: bytes) -> None:
        """Take keys of a terminal; see `KEYS`. They mean the first simulation."""
        for key in keys.decode("ascii", "ignore").lower():
            if key == "s":
                self.outcome(Event.SUCCESS.cause)
            elif key == "f":
                self.outcome(Event.FAILURE.cause)
            elif key == "i":
                self.intervention()

    def begin(self, simulations: NDArray[np.intp]) -> None:
        """Forget what was said about episodes before."""
        with self._lock:
            for simulation in simulations.tolist():
                self._outcomes.pop(simulation, None)
                self._driving.discard(simulation)

    def frame(self, event: NDArray[np.int64], running: Mask) -> tuple[NDArray[np.int64], Mask]:
        """Return the events of a frame with what was said, and where somebody intervenes.

        Args:
            event: what happened, shape (n,).
            running: which simulations run, shape (n,).

        Returns:
            Both of shape (n,).
        """
        driven = np.zeros(self._n, np.bool_)
        with self._lock:
            if not self._outcomes and not self._driving:
                return event, driven
            driven[list(self._driving)] = True
            said = event.copy()
            for simulation in [one for one in self._outcomes if running[one]]:
                outcome = self._outcomes.pop(simulation)
                if said[simulation] not in _HARD:
                    said[simulation] = outcome
        return said, driven & running

    def _checked(self, simulation: int) -> int:
        if not 0 <= simulation < self._n:
            raise ConfigError(f"There is no simulation {simulation}; valid: 0 to {self._n - 1}.")
        return simulation
