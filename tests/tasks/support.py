"""Episodes of a task on made-up truth: no simulator, no robot."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from bhd_lerobot.tasks.task import Event


class Judged:
    """Episodes side by side, and what came of them; one that ended does not run any more."""

    def __init__(self, task: Any, scenes: Sequence[Any]) -> None:
        self.n, self.task, self.scenes = len(scenes), task, scenes
        task.begin(np.arange(self.n), scenes)
        self.running = np.ones(self.n, np.bool_)
        self.rewards, self.events, self.frames = np.zeros(self.n), np.zeros(self.n, int), np.zeros(self.n, int)

    def judge(self, truth: Any) -> np.ndarray:
        """Judge a frame; return its rewards."""
        reward, event = self.task.judge(truth, self.running.copy())
        assert (reward[~self.running] == 0).all()
        assert (event[~self.running] == Event.NOTHING).all()
        self.frames += self.running
        self.rewards += reward
        self.events = np.where(self.running, event, self.events)
        self.running &= event == Event.NOTHING
        return reward

    def outcome(self, sim: int = 0) -> Any:
        return self.task.outcome(sim, Event(int(self.events[sim])))
