"""What the learner of `bhd-train` sees of the simulations, and what it gets for a frame.

Import this only where stable-baselines3 is known to be there.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from lerobot.utils.constants import OBS_ENV_STATE, OBS_STATE
from numpy.typing import NDArray

from bhd_lerobot.control.messages import Limit
from bhd_lerobot.envs.episodes import SteppedEpisodes
from bhd_lerobot.envs.stable_baselines import BhdSb3VecEnv
from bhd_lerobot.envs.vector import BhdVectorEnv
from bhd_lerobot.tasks.task import Event
from bhd_lerobot.training.rl.config import RewardConfig
from bhd_lerobot.training.rl.parts import RlParts, Rows, rows_of

Array = NDArray[np.float64]

# The policy's mean is never cut off: what lies outside of the robot's limits is the cerebellum's business, in training
# as everywhere else.
_UNBOUNDED = 1e6


class FeatureStack:
    """Histories of n robots, and the vectors that `bhd_mlp` makes of them.

    Normalisation and features are computed by the policy and its processors, so that what is learned here is what runs
    elsewhere; only a convolution over beams, which is learned, is left to the learner.
    """

    def __init__(self, front: Any, before: Any, n: int) -> None:
        self._front, self._before, self.size = front, before, int(front.feature_size)
        config = front.config
        self._length, self._single = config.history, config.n_obs_steps == 1
        self._back = np.arange(config.n_obs_steps)[::-1] * config.obs_stride
        self._keys = [key for key in (OBS_STATE, OBS_ENV_STATE) if key in config.input_features]
        self._history = {
            key: np.zeros((self._length, n, config.input_features[key].shape[0]), np.float32) for key in self._keys
        }
        self._head = 0

    def restart(self, ids: NDArray[np.intp], rows: Rows) -> None:
        """Begin episodes: nothing was before their first frame but that frame."""
        for key in self._keys:
            self._history[key][:, ids] = rows[key][ids]

    def push(self, rows: Rows) -> None:
        """Add a frame of all robots."""
        self._head = (self._head + 1) % self._length
        for key in self._keys:
            self._history[key][self._head] = rows[key]

    def features(self) -> NDArray[np.float32]:
        """Return the vectors, shape (n, size)."""
        batch = {}
        for key in self._keys:
            picked = self._history[key][(self._head - self._back) % self._length]
            values = picked[0] if self._single else picked.swapaxes(0, 1)
            batch[key] = torch.from_numpy(np.ascontiguousarray(values))
        with torch.inference_mode():
            return self._front.features(self._before(batch)).numpy()


def in_units(after: Any, actions: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return normalised actions in the robot's units, shape (n, actions), by the policy's own postprocessor."""
    with torch.inference_mode():
        return after(torch.from_numpy(np.ascontiguousarray(actions, np.float32))).numpy()


class Shaping:
    """The learner's reward of n simulations; `gamma` is the discount of a frame."""

    def __init__(self, config: RewardConfig, gamma: float, n: int) -> None:
        self._config, self._gamma = config, gamma
        self._events: Array = np.zeros(max(Event) + 1)
        for name, value in config.events.items():
            self._events[Event[name.upper()]] = value
        self._potential: Array = np.zeros(n)
        self.uses_potential = config.potential != "none"

    def potential(self, episodes: Any) -> Array:
        """Return the potential of every simulation's state now, shape (n,)."""
        truth = episodes.simulation.truth()
        target = episodes.task.environment_state(truth)
        return pose_potential(truth.tool_pose, target[:, :7], self._config.per_m, self._config.per_rad)

    def restart(self, ids: NDArray[np.intp], potential: Array) -> None:
        """Begin episodes with these potentials, shape (n,); only the rows `ids` are read."""
        self._potential[ids] = potential[ids]

    def __call__(
        self, reward: Array, event: NDArray[np.int64], terminated: NDArray[np.bool_], potential: Array | None = None
    ) -> Array:
        """Return the learner's reward of a frame, shape (n,), as all arguments: `potential` is that at its end.

        Where an episode `terminated`, the state has the potential 0.
        """
        shaped = self._config.scale * reward + self._events[event] + self._config.frame
        if self.uses_potential and potential is not None:
            new = np.where(terminated, 0.0, potential)
            shaped += self._gamma * new - self._potential
            self._potential = new
        return shaped


def pose_potential(tool: Array, target: Array, per_m: float, per_rad: float) -> Array:
    """Return minus the weighted distance between poses, shape (n,).

    A pose is x, y, z [m] and a quaternion wxyz, shape (n, 7); the weights are in 1/m and 1/rad.
    """
    distance = np.linalg.norm(tool[:, :3] - target[:, :3], axis=1)
    angle = 2 * np.arccos(np.minimum(np.abs((tool[:, 3:] * target[:, 3:]).sum(axis=1)), 1.0))
    return -per_m * distance - per_rad * angle


def privileged_state(episodes: SteppedEpisodes) -> NDArray[np.float32]:
    """Return what the simulator, the task and the cerebellum know beyond the observation, shape (n, k).

    The last number is whether the cerebellum kept the robot from an obstacle in the last frame: the flag CLEARANCE.
    """
    kept = (episodes.limits & Limit.CLEARANCE) != 0
    parts = episodes.simulation.privileged_state(), episodes.task.privileged_state(), kept[:, None]
    return np.concatenate(parts, axis=1, dtype=np.float32)


class RlVecEnv(BhdSb3VecEnv):
    """The environment as the learner sees it: feature vectors in, normalised actions out, and rewards of its own.

    A vector is what the actor sees, `stack.size` numbers, and behind that, if it is privileged, what only the critic
    sees. `infos[i]["episode"]` holds the task's own return, not the learner's. `env` has the autoreset mode DISABLED.
    """

    def __init__(
        self, env: BhdVectorEnv, parts: RlParts, reward: RewardConfig, gamma: float, *, privileged: bool = False
    ) -> None:
        self.stack = FeatureStack(parts.front, parts.before, env.num_envs)
        self.shaping = Shaping(reward, gamma, env.num_envs)
        self._after, self._privileged = parts.after, privileged
        width = self.stack.size + (privileged_state(env.episodes).shape[1] if privileged else 0)
        super().__init__(
            env,
            spaces.Box(-np.inf, np.inf, (width,), np.float32),
            spaces.Box(-_UNBOUNDED, _UNBOUNDED, env.single_action_space.shape, np.float32),
        )

    def _in_units(self, actions: NDArray[np.float32]) -> NDArray[np.float32]:
        return in_units(self._after, actions)

    def _push(self, observation: dict[str, Any]) -> None:
        self.stack.push(rows_of(observation))

    def _begin(self, ids: NDArray[np.intp], observation: dict[str, Any]) -> None:
        super()._begin(ids, observation)
        self.stack.restart(ids, rows_of(observation))
        if self.shaping.uses_potential:
            self.shaping.restart(ids, self.shaping.potential(self.env.episodes))

    def _observations(self) -> NDArray[np.float32]:
        features = self.stack.features()
        return np.hstack([features, privileged_state(self.env.episodes)]) if self._privileged else features

    def _rewards(self, reward: Array, event: NDArray[np.int64], terminated: NDArray[np.bool_]) -> Array:
        potential = self.shaping.potential(self.env.episodes) if self.shaping.uses_potential else None
        return self.shaping(reward, event, terminated, potential)

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Do nothing: which episodes are run, the environment's own seed says."""
        return [None] * self.num_envs
