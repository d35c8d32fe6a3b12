"""A brain from which a person takes over, and to which they give back."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.control.commands import Chunk, Command, CommandResult
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.policies.brain import Brain, Observation, RobotFeatures
from bhd_lerobot.policies.manipulation.goal_brain import GoalBrain
from bhd_lerobot.policies.teleop.brain import TeleopBrain

CAUSE = "person"


class TakeoverBrain(Brain):
    """Drives with a brain, and with a person while they have taken over.

    Args:
        brain: what drives otherwise; it starts afresh whenever it is given back to.
        person: the person's teleoperator.
        is_taken: returns whether the person drives now.
    """

    def __init__(self, brain: Brain, person: TeleopBrain, is_taken: Callable[[], bool]) -> None:
        if isinstance(brain, GoalBrain):
            raise ConfigError(
                f"brain.type is {brain.name!r}, which gives goals; a person can take over from a brain that gives "
                "actions, such as a trained policy."
            )
        super().__init__(None)
        self._brain, self._person, self._is_taken = brain, person, is_taken
        self.name, self.needs, self.has_plan = brain.name, brain.needs, brain.has_plan
        self.uses_images, self.uses_privileged_state = brain.uses_images, brain.uses_privileged_state
        self._was_taken = self._is_settled = False
        self._start: tuple[Any, ...] = ()
        self._left: list[NDArray[np.float64]] = []  # of the brain: the action that is in force, and its chunk's rest

    def bind(self, robot: RobotFeatures) -> None:
        """Learn what robot both drive."""
        self._brain.bind(robot)
        self._person.bind(robot)

    def reset(self, ids: NDArray[np.intp], seeds: Sequence[int], n: int, instructions: Sequence[str] = ()) -> None:
        """Start an episode."""
        self._start = ids, seeds, n, instructions
        self._was_taken = self._is_settled = False
        self._left = []
        self._brain.reset(*self._start)
        self._person.reset(*self._start)

    def _settle(self) -> bool:
        """Settle, once a frame, whether the person drives in it; return that."""
        if self._is_settled:
            return self._was_taken
        self._is_settled = True
        is_taken = self._is_taken()
        if is_taken and not self._was_taken:
            self._person.reset(*self._start)
            self._person.hold(self._left[0] if self._left else None)
        elif self._was_taken and not is_taken:
            self._brain.reset(*self._start)  # what it planned is of another time
        self._was_taken = is_taken
        return is_taken

    def needs_images(self, results: Mapping[int, Sequence[CommandResult]]) -> NDArray[np.bool_]:
        """Return where the one who drives looks."""
        driver = self._person if self._settle() else self._brain
        return driver.needs_images(results)

    def act(self, observation: Observation) -> Command:
        """Return the action of the one who drives.

        While a person who has taken over gives none yet, the brain's last one stays, without the rest of its chunk.
        """
        is_taken = self._settle()
        self._is_settled = False
        if is_taken:
            command = self._person.act(observation)
            if command is None and len(self._left) > 1:
                command = self._left[0]
            self._left = []
            return command
        command = self._brain.act(observation)
        if isinstance(command, Chunk):
            self._left = list(command.actions)
        elif command is None:
            self._left = self._left[1:] or self._left
        else:
            self._left = [command] if isinstance(command, np.ndarray) else []
        return command

    def subtasks(self) -> Sequence[str]:
        """Return what the brain is doing."""
        return self._brain.subtasks()

    def plan(self, sim: int) -> dict[str, Any]:
        """Return the brain's plan."""
        return self._brain.plan(sim)

    def advice(self) -> NDArray[np.float64] | None:
        """Return what the brain's expert would do; NaN while a person drives, who is the expert then."""
        advised = self._brain.advice()
        return np.full_like(advised, np.nan) if advised is not None and self._was_taken else advised

    def interventions(self) -> NDArray[np.bool_]:
        """Return whether the person, or the brain's expert, drove in the frame that `act` decided last, shape (1,)."""
        by_expert = None if self._was_taken else self._brain.interventions()
        return np.array([self._was_taken]) if by_expert is None else by_expert

    def causes(self) -> Sequence[str]:
        """Return who took over."""
        return [CAUSE] if self._was_taken else self._brain.causes()

    def parameters(self) -> dict[str, Any]:
        """Return the parameters of both."""
        return {**self._brain.parameters(), "takeover": self._person.parameters()}

    def close(self) -> None:
        """Disconnect the teleoperator, and close the brain."""
        self._person.close()
        self._brain.close()
