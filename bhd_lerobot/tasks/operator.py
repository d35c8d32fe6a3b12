"""A task whose episodes a person judges, because the robot cannot tell their outcome."""

from typing import Any

from bhd_lerobot.tasks.free import FreeTask
from bhd_lerobot.tasks.task import Task


class OperatorTask(FreeTask):
    """A task in front of a real robot that does not measure what the task is judged by.

    An episode ends when a person states how (`bhd_lerobot.rollout.marks`), or when its time is over. The brain is told
    nothing of the scene, and there is no reward. What the task asks for stays the same.

    Args:
        task: the task.
        n: number of robots.
        fps: frames a second [Hz].
    """

    def __init__(self, task: Task, n: int, fps: int) -> None:
        super().__init__(task, n, fps)
        self._task, self.name, self.needs = task, task.name, task.needs

    def sample(self, seed: int) -> Any:
        """Return the scene of the episode with this seed, which a person is to set up."""
        return self._task.sample(seed)

    def instruction(self, scene: Any) -> str:
        """Return what a person would ask for in this scene."""
        return self._task.instruction(scene)

    def parameters(self) -> dict[str, Any]:
        """Return everything that defines the task, and that a person judges it."""
        return {**self._task.parameters(), "judged_by": "operator"}


def judged(task: Task, knows: frozenset[str] | None, n: int, fps: int) -> Task:
    """Return a task as it can be judged: as it is, or by a person.

    Args:
        task: the task.
        knows: the fields of the truth that the robot measures; None if it is simulated and all are known.
        n: number of robots.
        fps: frames a second [Hz].
    """
    if knows is None or (task.judged_by is not None and task.judged_by <= knows):
        return task
    return OperatorTask(task, n, fps)
