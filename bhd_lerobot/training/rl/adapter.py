"""Our vector environment as stable-baselines3 wants it. Import this only where that package is known to be there."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from bhd_lerobot.envs.vector import BhdVectorEnv
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.tasks.task import Event
from bhd_lerobot.training.rl.features import ActionUnits, FeatureStack, rows_of
from bhd_lerobot.training.rl.shaping import Shaping

# The policy's mean is never cut off: what lies outside of the robot's limits is the cerebellum's business, in training
# as everywhere else.
_UNBOUNDED = 1e6


class RlVecEnv(VecEnv):
    """n simulations as stable-baselines3's `VecEnv`: feature vectors in, normalised actions out.

    An episode that ended begins anew in the same step. Its last observation is in `infos[i]["terminal_observation"]`,
    and `infos[i]["TimeLimit.truncated"]` says whether only its time was over, so that the learner adds the value of
    what would have come. `infos[i]["episode"]` holds the task's own return `r`, not the learner's, and the length `l`.

    Attributes:
        env: the environment.
        on_episode: is told of each episode that ended: a dictionary with `return`, `length`, `event`, `success`,
            `score`.

    Args:
        env: with autoreset mode DISABLED.
        stack: what the network sees.
        units: gives actions the robot's units.
        shaping: what the learner gets.
    """

    def __init__(self, env: BhdVectorEnv, stack: FeatureStack, units: ActionUnits, shaping: Shaping) -> None:
        if env.autoreset_mode.value != "Disabled":
            raise ConfigError(f"autoreset_mode is {env.autoreset_mode.value}; the adapter needs Disabled.")
        self.env, self._stack, self._units, self._shaping = env, stack, units, shaping
        self.on_episode: Callable[[dict[str, Any]], None] = lambda episode: None
        size = env.single_action_space.shape[0]  # type: ignore[index]
        super().__init__(
            env.num_envs,
            spaces.Box(-np.inf, np.inf, (stack.size,), np.float32),
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
        return self._stack.features()

    def step_async(self, actions: NDArray[np.float32]) -> None:
        """Take normalised actions, shape (n, a)."""
        self._actions = actions

    def step_wait(self) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        """Let one frame go by; return vectors, the learner's rewards, ends and infos."""
        observation, reward, terminated, truncated, info = self.env.step(self._units(self._actions))
        self._stack.push(rows_of(observation))
        self._return += reward
        self._length += 1
        done = terminated | truncated
        ended = np.flatnonzero(done)
        event = np.zeros(self.num_envs, np.int64)
        if len(ended):
            event[ended] = [Event[name.upper()] for name in info["event"][ended]]
        potential = self._shaping.potential(self.env.stage) if self._shaping.uses_potential else None
        shaped = self._shaping(reward, event, terminated, potential).astype(np.float32)
        infos = [self._nothing] * self.num_envs
        if len(ended):
            self._finish(ended, truncated, info, infos)
            observation, _ = self.env.reset(options={"reset_mask": done})
            self._begin(ended, observation)
        return self._stack.features(), shaped, done, infos

    def _finish(
        self, ended: NDArray[np.intp], truncated: NDArray[np.bool_], info: dict[str, Any], infos: list[dict[str, Any]]
    ) -> None:
        last = self._stack.features(ended)
        for row, sim in enumerate(ended.tolist()):
            episode = {
                "return": float(self._return[sim]),
                "length": int(self._length[sim]),
                "event": str(info["event"][sim]),
                "success": bool(info["is_success"][sim]),
                "score": float(info["score"][sim]),
            }
            infos[sim] = {
                "terminal_observation": last[row],
                "TimeLimit.truncated": bool(truncated[sim]),
                "episode": {"r": episode["return"], "l": episode["length"], "t": 0.0},
                "is_success": episode["success"],
                "event": episode["event"],
                "score": episode["score"],
            }
            self.on_episode(episode)

    def _begin(self, ids: NDArray[np.intp], observation: dict[str, Any]) -> None:
        self._stack.restart(ids, rows_of(observation))
        if self._shaping.uses_potential:
            self._shaping.restart(ids, self._shaping.potential(self.env.stage))
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
        """Tell that nothing is wrapped."""
        return [False for _ in self._get_indices(indices)]

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Do nothing: which episodes are run, the environment's own seed says."""
        return [None] * self.num_envs
