"""What the learner gets for a frame, made from what the task gives."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.tasks.task import Event
from bhd_lerobot.training.rl.sections import RewardConfig

Array = NDArray[np.float64]


class Shaping:
    """The learner's reward of n simulations.

    Args:
        config: how it is made.
        gamma: discount of a frame.
        n: simulations.
    """

    def __init__(self, config: RewardConfig, gamma: float, n: int) -> None:
        self._config, self._gamma = config, gamma
        self._events: Array = np.zeros(max(Event) + 1)
        for name, value in config.events.items():
            self._events[Event[name.upper()]] = value
        self._potential: Array = np.zeros(n)
        self.uses_potential = config.potential != "none"

    def potential(self, stage: Any) -> Array:
        """Return the potential of every simulation's state now, shape (n,)."""
        truth = stage.simulation.truth()
        target = stage.task.environment_state(truth)
        return pose_potential(truth.tool_pose, target[:, :7], self._config.per_m, self._config.per_rad)

    def restart(self, ids: NDArray[np.intp], potential: Array) -> None:
        """Begin episodes with these potentials, shape (n,); only the rows `ids` are read."""
        self._potential[ids] = potential[ids]

    def __call__(
        self, reward: Array, event: NDArray[np.int64], terminated: NDArray[np.bool_], potential: Array | None = None
    ) -> Array:
        """Return the learner's reward of a frame, shape (n,).

        Args:
            reward: the task's, shape (n,); it stays as it is.
            event: `Event` that the frame ended with, shape (n,).
            terminated: whether the episode ended for good, shape (n,): such a state has the potential 0.
            potential: of the state at the frame's end, shape (n,), with a potential.
        """
        shaped = self._config.scale * reward + self._events[event] + self._config.frame
        if self.uses_potential and potential is not None:
            new = np.where(terminated, 0.0, potential)
            shaped += self._gamma * new - self._potential
            self._potential = new
        return shaped


def pose_potential(tool: Array, target: Array, per_m: float, per_rad: float) -> Array:
    """Return minus the weighted distance between poses, shape (n,).

    Args:
        tool: x, y, z [m] and quaternion wxyz, shape (n, 7).
        target: the same.
        per_m: weight of the distance [1/m].
        per_rad: weight of the angle [1/rad].
    """
    distance = np.linalg.norm(tool[:, :3] - target[:, :3], axis=1)
    angle = 2 * np.arccos(np.minimum(np.abs((tool[:, 3:] * target[:, 3:]).sum(axis=1)), 1.0))
    return -per_m * distance - per_rad * angle
