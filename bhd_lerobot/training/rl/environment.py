"""Our vector environment as stable-baselines3 wants it, and what the learner gets for a frame.

Import this only where stable-baselines3 is known to be there.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from bhd_lerobot.envs.vector import BhdVectorEnv
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.tasks.task import Event
from bhd_lerobot.training.rl.config import RewardConfig
from bhd_lerobot.training.rl.features import FeatureStack, in_units, rows_of
from bhd_lerobot.training.rl.parts import RlParts
from bhd_lerobot.training.rl.privileged import privileged_state

Array = NDArray[np.float64]

# The policy's mean is never cut off: what lies outside of the robot's limits is the cerebellum's business, in training
# as everywhere else.
_UNBOUNDED = 1e6


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


class RlVecEnv(VecEnv):
    """n simulations as stable-baselines3's `VecEnv`: feature vectors in, normalised actions out.

    A vector is what the actor sees, `stack.size` numbers, and behind that, if it is privileged, what only the critic
    sees.

    An episode that ended begins anew in the same step. Its last observation is in `infos[i]["terminal_observation"]`,
    and `infos[i]["TimeLimit.truncated"]` says whether only its time was over, so that the learner adds the value of
    what would have come. `infos[i]["episode"]` holds the task's own return `r`, not the learner's, and the length `l`;
    besides there are `is_success`, `event` and `score`.

    Attributes:
        env: the environment.
        stack: what the network sees.
        shaping: what the learner gets.

    Args:
        env: with autoreset mode DISABLED.
        parts: the policy, whose inputs and outputs these are.
        reward: how the learner's reward is made.
        gamma: discount of a frame.
        privileged: whether the critic sees more than the actor: `privileged_state`.
    """

    def __init__(
        self, env: BhdVectorEnv, parts: RlParts, reward: RewardConfig, gamma: float, *, privileged: bool = False
    ) -> None:
        if env.autoreset_mode.value != "Disabled":
            raise ConfigError(f"autoreset_mode is {env.autoreset_mode.value}; the adapter needs Disabled.")
        self.env = env
        self.stack = FeatureStack(parts.front, parts.before, env.num_envs)
        self.shaping = Shaping(reward, gamma, env.num_envs)
        self._after, self._privileged = parts.after, privileged
        width = self.stack.size + (privileged_state(env.stage).shape[1] if privileged else 0)
        size = env.single_action_space.shape[0]  # type: ignore[index]
        super().__init__(
            env.num_envs,
            spaces.Box(-np.inf, np.inf, (width,), np.float32),
            spaces.Box(-_UNBOUNDED, _UNBOUNDED, (size,), np.float32),
        )
        self._all = np.arange(env.num_envs)
        self._return = np.zeros(env.num_envs)
        self._length = np.zeros(env.num_envs, np.int64)
        self._actions: NDArray[np.float32] = np.zeros((env.num_envs, size), np.float32)
        self._nothing: dict[str, Any] = {}

    def reset(self) -> NDArray[np.float32]:
        """Begin the next episode everywhere; return vectors, shape (n, size)."""
        observation, _ = self.env.reset()
        self._begin(self._all, observation)
        return self._vectors()

    def step_async(self, actions: NDArray[np.float32]) -> None:
        """Take normalised actions, shape (n, a)."""
        self._actions = actions

    def step_wait(self) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        """Let one frame go by; return vectors, the learner's rewards, ends and infos."""
        observation, reward, terminated, truncated, info = self.env.step(in_units(self._after, self._actions))
        self.stack.push(rows_of(observation))
        self._return += reward
        self._length += 1
        done = terminated | truncated
        ended = np.flatnonzero(done)
        event = np.zeros(self.num_envs, np.int64)
        if len(ended):
            event[ended] = [Event[name.upper()] for name in info["event"][ended]]
        potential = self.shaping.potential(self.env.stage) if self.shaping.uses_potential else None
        shaped = self.shaping(reward, event, terminated, potential).astype(np.float32)
        infos = [self._nothing] * self.num_envs
        if len(ended):
            self._finish(ended, truncated, info, infos)
            observation, _ = self.env.reset(options={"reset_mask": done})
            self._begin(ended, observation)
        return self._vectors(), shaped, done, infos

    def _vectors(self) -> NDArray[np.float32]:
        features = self.stack.features()
        return np.hstack([features, privileged_state(self.env.stage)]) if self._privileged else features

    def _finish(
        self, ended: NDArray[np.intp], truncated: NDArray[np.bool_], info: dict[str, Any], infos: list[dict[str, Any]]
    ) -> None:
        last = self._vectors()[ended]
        for row, sim in enumerate(ended.tolist()):
            infos[sim] = {
                "terminal_observation": last[row],
                "TimeLimit.truncated": bool(truncated[sim]),
                "episode": {"r": float(self._return[sim]), "l": int(self._length[sim]), "t": 0.0},
                "is_success": bool(info["is_success"][sim]),
                "event": str(info["event"][sim]),
                "score": float(info["score"][sim]),
            }

    def _begin(self, ids: NDArray[np.intp], observation: dict[str, Any]) -> None:
        self.stack.restart(ids, rows_of(observation))
        if self.shaping.uses_potential:
            self.shaping.restart(ids, self.shaping.potential(self.env.stage))
        self._return[ids] = 0.0
        self._length[ids] = 0

    # --- the rest of the interface -----------------------------------------------------------------------------------

    def close(self) -> None:
        """Free the simulations."""
        self.env.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return an attribute of some environments."""
        if attr_name == "render_mode":  # asked for before the environment is set
            return [None] * self.num_envs
        values = self.env.get_attr(attr_name)
        return [values[i] for i in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set an attribute of all environments."""
        self.env.set_attr(attr_name, value)

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        """Call a method of some environments."""
        values = self.env.call(method_name, *method_args, **method_kwargs)
        return [values[i] for i in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        """Return that nothing is wrapped."""
        return [False for _ in self._get_indices(indices)]

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Do nothing: which episodes are run, the environment's own seed says."""
        return [None] * self.num_envs
