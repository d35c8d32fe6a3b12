"""What brains that give goals have in common: one goal at a time for each simulation, and its result."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.control.commands import BrainCommand, CommandResult, Goals
from bhd_lerobot.policies.brain import Observation


class GoalBrain(ABC):
    """A brain that gives each simulation one goal after the other.

    A subclass says in `_decide` what comes next; it is asked at the start and whenever a goal has ended.
    """

    name: str
    robot_type = "ur5"
    uses_images = False
    has_plan = True

    def __init__(self) -> None:
        self._pending: list[str | None] = []
        self._numbers: list[int] = []
        self._doing: list[str] = []
        self._done: list[bool] = []

    @abstractmethod
    def _begin(self, sim: int, seed: int, instruction: str) -> None:
        """Start an episode in one simulation."""

    @abstractmethod
    def _decide(self, sim: int, seen: Observation, result: CommandResult | None) -> BrainCommand | None:
        """Return the next goal of one simulation; None for none any more.

        Args:
            sim: the simulation.
            seen: what all simulations see.
            result: how the last goal ended; None at the start.
        """

    def reset(self, ids: NDArray[np.intp], seeds: Sequence[int], n: int, instructions: Sequence[str] = ()) -> None:
        """Start episodes in some simulations."""
        if len(self._pending) != n:
            self._pending, self._numbers = [None] * n, [0] * n
            self._doing, self._done = [""] * n, [False] * n
        for place, sim in enumerate(np.asarray(ids).tolist()):
            self._pending[sim], self._numbers[sim], self._doing[sim], self._done[sim] = None, 0, "", False
            self._begin(sim, seeds[place], instructions[place] if instructions else "")

    def act(self, observation: Observation) -> Goals:
        """Return the goals that come next."""
        commands: dict[int, list[BrainCommand]] = {}
        running = np.ones(len(self._pending), np.bool_) if observation.running is None else observation.running
        for sim in np.flatnonzero(running).tolist():
            if self._done[sim]:
                continue
            result = None
            if self._pending[sim] is not None:
                ends = [one for one in observation.results.get(sim, ()) if one.task_id == self._pending[sim]]
                if not ends:
                    continue
                result = ends[-1]
            command = self._decide(sim, observation, result)
            self._pending[sim] = None if command is None else command.task_id
            self._done[sim] = command is None
            if command is not None:
                commands[sim] = [command]
        return Goals(commands)

    def subtasks(self) -> Sequence[str]:
        """Return what each simulation's brain is doing, in words."""
        return self._doing

    def plan(self, sim: int) -> dict[str, Any]:
        """Return the plan of one simulation."""
        return {}

    def _name(self, sim: int, step: str) -> str:
        """Return a new name for a goal."""
        self._numbers[sim] += 1
        return f"{self._numbers[sim]}-{step}"
