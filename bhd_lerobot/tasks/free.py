"""The task `free`: an instruction and a time, for every robot; a person says how an episode ends."""

from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.arenas import ARENAS
from bhd_lerobot.bodies.tabletop import TableScene
from bhd_lerobot.options.declared import OneOf, Positive
from bhd_lerobot.tasks.task import BaseTask, Event, Outcome, TaskConfig


@TaskConfig.register_subclass("free")
@dataclass
class FreeConfig(TaskConfig):
    """What a robot is to do, in words.

    Attributes:
        instruction: what it is to do; also what a policy is told.
        duration_s: longest duration of an episode [s].
        arena: where a simulated base is.
    """

    instruction: str = ""
    duration_s: Positive = 60.0
    arena: Annotated[str, OneOf(ARENAS)] = "turtlebot3_world"


class FreeTask(BaseTask):
    """An episode ends when a person says how, or when its time is over; there is no reward."""

    name = "free"
    needs: tuple[type, ...] = ()
    judged_by: frozenset[str] | None = frozenset()
    config: FreeConfig

    def sample(self, seed: int) -> Any:
        """Return where a simulated robot is; None if it is not known what robot it is."""
        if self.body and self.body.drive:
            return self.arena(self.config.arena, seed)
        return TableScene("empty", (), self.body.arm.home) if self.body and self.body.arm else None

    def instruction(self, scene: Any) -> str:
        """Return the instruction."""
        return self.config.instruction

    def judge(self, truth: Any, running: NDArray[np.bool_]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Return no reward, and a time-out when the time is over, each of shape (n,)."""
        return np.zeros(len(self.frame)), self.count_frame(running)

    def outcome(self, sim: int, event: Event) -> Outcome:
        """Return how an episode ended: as the person said."""
        return Outcome(event == Event.SUCCESS, event, float(event == Event.SUCCESS))
