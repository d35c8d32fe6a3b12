"""Who drives in each frame: the brain or an intervening expert, by setpoints or goals; and inference times."""

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.control.commands import Goals, Mixed
from bhd_lerobot.policies.brain import Brain, Observation
from bhd_lerobot.tasks.task import Event

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Intervention:
    """Frames `first` to `end` - 1, in which an expert or a person drove, and why, as text."""

    first: int
    end: int
    cause: str


class DriverLog:
    """Who drives n simulations, from one decision of a brain to the next."""

    def __init__(self, brain: Any, n: int, frames: int) -> None:
        # Not isinstance: a brain may be wrapped in one that passes on what it does not know.
        self.intervenes = hasattr(brain, "interventions")
        self.is_mixed = self.gives_goals = False
        self._brain = brain
        self._taken, self._by_goals = np.zeros((2, n, frames), np.bool_)
        self._now, self._before = np.zeros((2, 2, n), np.bool_)  # taken over, by goals
        self._fresh = np.ones(n, np.bool_)
        self._causes: list[dict[int, str]] = [{} for _ in range(n)]
        self._why, self._why_before = [""] * n, [""] * n

    def start(self, ids: NDArray[np.intp]) -> None:
        """Start episodes in some simulations."""
        self._fresh[ids] = True
        for sim in ids.tolist():
            self._causes[sim] = {}

    def decided(self, decision: Any) -> None:
        """Note the command that the brain returned."""
        n = len(self._fresh)
        self.is_mixed = isinstance(decision, Mixed)
        self.gives_goals = self.is_mixed or isinstance(decision, Goals)
        self._before = self._now
        taken = np.array(self._brain.interventions(), np.bool_) if self.intervenes else np.zeros(n, np.bool_)
        by_goals = decision.by_goals if self.is_mixed else np.full(n, self.gives_goals)
        self._now = np.stack([taken, by_goals])
        self._before[:, self._fresh] = self._now[:, self._fresh]
        self._why_before = self._why
        if np.count_nonzero(taken):
            self._why = list(self._brain.causes())
            pairs = zip(self._fresh, self._why, self._why_before, strict=True)
            self._why_before = [now if is_fresh else before for is_fresh, now, before in pairs]
        self._fresh[:] = False

    def frame(self, running: NDArray[np.intp], length: NDArray[np.int64], *, is_missed: bool) -> tuple[Mask, Mask]:
        """Return in which simulations an intervention was on, and which followed goals, in a frame; each of shape (n,).

        Args:
            running: the simulations that are in an episode.
            length: frames of each episode before this one, shape (n,).
            is_missed: whether the frame went by during inference: the decision before was still in force.
        """
        taken, by_goals = self._before if is_missed else self._now
        rows = length[running]
        self._taken[running, rows], self._by_goals[running, rows] = taken[running], by_goals[running]
        if np.count_nonzero(taken[running]):
            causes = self._why_before if is_missed else self._why
            for sim, row in zip(running.tolist(), rows.tolist(), strict=True):
                if taken[sim]:
                    self._causes[sim][row] = causes[sim]
        return taken, by_goals

    def interventions(self, sim: int, length: int) -> list[Intervention] | None:
        """Return the interventions of an episode that has ended; None if the brain has no interventions."""
        if not self.intervenes:
            return None
        causes = self._causes[sim]
        return [Intervention(first, end, causes[first]) for first, end in spans(self._taken[sim, :length])]

    def goal_frames(self, sim: int, length: int) -> list[tuple[int, int]] | None:
        """Return when an episode followed goals, as first frames and those after the last.

        None if it did so always, or never.
        """
        return spans(self._by_goals[sim, :length]) if self.is_mixed else None


def flagged(event: NDArray[np.int64], taken: Mask) -> NDArray[np.int64]:
    """Return the events of a frame with the interventions among them: what ends an episode takes precedence."""
    return np.where(taken & (event == Event.NOTHING), int(Event.INTERVENTION), event)


def spans(mask: Mask) -> list[tuple[int, int]]:
    """Return where a mask of shape (frames,) is true, as first frames and those after the last."""
    edges = np.flatnonzero(np.diff(mask.astype(np.int8), prepend=0, append=0))
    return [(int(first), int(end)) for first, end in edges.reshape(-1, 2)]


class TimedBrain:
    """A brain whose calls are timed, in `times` [s]; everything else is the brain's own."""

    def __init__(self, brain: Brain) -> None:
        self._brain = brain
        self.times: list[float] = []

    def __getattr__(self, name: str) -> Any:
        return getattr(self._brain, name)

    def act(self, observation: Observation) -> Any:
        """Return the command of the brain, and note how long it took."""
        started = time.perf_counter()
        try:
            return self._brain.act(observation)
        finally:
            self.times.append(time.perf_counter() - started)
