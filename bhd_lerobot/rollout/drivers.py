"""Who drives in each frame: the brain or an intervening expert."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.policies.brain import Brain
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

    def __init__(self, brain: Brain, n: int) -> None:
        self._brain = brain
        self._intervenes = False
        self._now, self._before = np.zeros((2, n), np.bool_)
        self._fresh = np.ones(n, np.bool_)
        self._found: list[list[Intervention]] = [[] for _ in range(n)]
        self._why, self._why_before = [""] * n, [""] * n

    def start(self, ids: NDArray[np.intp]) -> None:
        """Start episodes in some simulations."""
        self._fresh[ids] = True
        for sim in ids.tolist():
            self._found[sim] = []

    def decided(self) -> None:
        """Note who drives by the decision that the brain has just made."""
        taken = self._brain.interventions()
        self._intervenes = taken is not None
        if taken is None:
            return
        self._before, self._now = self._now, np.array(taken, np.bool_)
        self._before[self._fresh] = self._now[self._fresh]
        self._why_before = self._why
        if np.count_nonzero(taken):
            self._why = list(self._brain.causes())
            pairs = zip(self._fresh, self._why, self._why_before, strict=True)
            self._why_before = [now if is_fresh else before for is_fresh, now, before in pairs]
        self._fresh[:] = False

    def frame(self, running: NDArray[np.intp], length: NDArray[np.int64], *, is_missed: bool) -> Mask:
        """Return in which simulations an intervention was on in a frame, shape (n,).

        Args:
            running: the simulations that are in an episode.
            length: frames of each episode before this one, shape (n,).
            is_missed: whether the frame went by during inference: the decision before was still in force.
        """
        taken = self._before if is_missed else self._now
        if np.count_nonzero(taken[running]):
            causes = self._why_before if is_missed else self._why
            for sim, row in zip(running.tolist(), length[running].tolist(), strict=True):
                if taken[sim]:
                    self._add(self._found[sim], row, causes[sim])
        return taken

    @staticmethod
    def _add(found: list[Intervention], row: int, cause: str) -> None:
        if found and found[-1].end == row:
            found[-1] = replace(found[-1], end=row + 1)
        else:
            found.append(Intervention(row, row + 1, cause))

    def interventions(self, sim: int) -> list[Intervention] | None:
        """Return the interventions of an episode that has ended; None if the brain has no interventions."""
        return self._found[sim] if self._intervenes else None


def flagged(event: NDArray[np.int64], taken: Mask) -> NDArray[np.int64]:
    """Return the events of a frame with the interventions among them: what ends an episode takes precedence."""
    return np.where(taken & (event == Event.NOTHING), int(Event.INTERVENTION), event)
