"""n simulations as one `VecEnv` of stable-baselines3.

Import this only where stable-baselines3 is known to be there: it is an extra.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from bhd_lerobot.envs.vector import BhdVectorEnv, info_of
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.tasks.task import Event


class BhdSb3VecEnv(VecEnv):
    """A `BhdVectorEnv` as stable-baselines3's `VecEnv`: with 16 simulations a fifth of the time of 16 single ones.

    An episode that ended begins anew in the same step. Its last observation is in `infos[i]["terminal_observation"]`,
    and `infos[i]["TimeLimit.truncated"]` reports whether only its time was over, so that the learner adds the value of
    what would have come. `infos[i]["episode"]` holds the task's return `r` and the length `l` [frames]. What else is in
    `infos` and `reset_infos` is what `BhdEnv` reports.

    Attributes:
        env: the environment.

    Args:
        env: with autoreset mode DISABLED.
        observation_space: of one environment; that of `env` if None.
        action_space: of one environment; that of `env` if None.
    """

    def __init__(
        self,
        env: BhdVectorEnv,
        observation_space: spaces.Space | None = None,
        action_space: spaces.Space | None = None,
    ) -> None:
        if env.autoreset_mode.value != "Disabled":
            raise ConfigError(
                f"autoreset_mode is {env.autoreset_mode.value!r}; stable-baselines3 needs autoreset_mode='Disabled'."
            )
        self.env = env
        super().__init__(
            env.num_envs, observation_space or env.single_observation_space, action_space or env.single_action_space
        )
        self.metadata = env.metadata
        self._all = np.arange(env.num_envs)
        self._return = np.zeros(env.num_envs)
        self._length = np.zeros(env.num_envs, np.int64)
        self._actions: NDArray[np.float32] = np.zeros((env.num_envs, env.single_action_space.shape[0]), np.float32)  # type: ignore[index]
        self._seen: Any = None
        self._first: int | None = None

    def reset(self) -> Any:
        """Begin the next episode everywhere; return observations, each of shape (n, …)."""
        observation, info = self.env.reset(seed=self._first)
        self._first = None
        self._reset_options()
        self.reset_infos = [info_of(info, sim) for sim in range(self.num_envs)]
        self._begin(self._all, observation)
        return self._observations()

    def step_async(self, actions: NDArray[np.float32]) -> None:
        """Take actions, shape (n, a)."""
        self._actions = actions

    def step_wait(self) -> tuple[Any, NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        """Let one frame go by; return observations, rewards, ends and infos."""
        observation, reward, terminated, truncated, info = self.env.step(self._in_units(self._actions))
        self._push(observation)
        self._return += reward
        self._length += 1
        done = terminated | truncated
        ended = np.flatnonzero(done)
        event = np.zeros(self.num_envs, np.int64)
        if len(ended):
            event[ended] = [Event[name.upper()] for name in info["event"][ended]]
        rewards = np.asarray(self._rewards(reward, event, terminated), np.float32)
        infos = [info_of(info, sim) for sim in range(self.num_envs)]
        for one, is_over in zip(infos, truncated & ~terminated, strict=True):
            one["TimeLimit.truncated"] = bool(is_over)
        if len(ended):
            self._finish(ended, infos)
            observation, begun = self.env.reset(options={"reset_mask": done})
            for sim in ended.tolist():
                self.reset_infos[sim] = info_of(begun, sim)
            self._begin(ended, observation)
        return self._observations(), rewards, done, infos

    def _finish(self, ended: NDArray[np.intp], infos: list[dict[str, Any]]) -> None:
        last = self._observations()
        for sim in ended.tolist():
            infos[sim] |= {
                "terminal_observation": {key: value[sim] for key, value in last.items()}
                if isinstance(last, dict)
                else last[sim],
                "episode": {"r": float(self._return[sim]), "l": int(self._length[sim]), "t": 0.0},
            }

    # --- what a learner with features and rewards of its own defines -------------------------------------------------

    def _in_units(self, actions: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the environment's actions, shape (n, a)."""
        return actions

    def _push(self, observation: dict[str, Any]) -> None:
        """Take what is seen after a frame."""
        self._seen = observation

    def _begin(self, ids: NDArray[np.intp], observation: dict[str, Any]) -> None:
        """Take what is seen where episodes begin."""
        self._seen = observation
        self._return[ids] = 0.0
        self._length[ids] = 0

    def _observations(self) -> Any:
        """Return what the learner gets."""
        return {key: np.array(value) for key, value in self._seen.items()}

    def _rewards(
        self, reward: NDArray[np.float64], event: NDArray[np.int64], terminated: NDArray[np.bool_]
    ) -> NDArray[np.float64]:
        """Return what the learner gets for a frame, shape (n,)."""
        return reward

    # --- the rest of the interface -----------------------------------------------------------------------------------

    def close(self) -> None:
        """Free the simulations."""
        self.env.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return an attribute of some environments."""
        return [getattr(member, attr_name) for member in self._members(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set an attribute of some environments, to one value.

        Raises:
            ConfigError: there is no such attribute, or it is one of all environments together.
        """
        members = self._members(indices)
        if attr_name == "render_mode" and len(members) < self.num_envs:
            raise ConfigError("render_mode is one of all environments together; set it without indices.")
        for member in members:
            member.set(attr_name, value)

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        """Call a method of some environments."""
        return [getattr(member, method_name)(*method_args, **method_kwargs) for member in self._members(indices)]

    def get_images(self) -> Sequence[NDArray[np.uint8] | None]:
        """Return each scene from outside, shape (height, width, 3); None without a render mode."""
        return self.env_method("render")

    def _members(self, indices: Any) -> list[Any]:
        return [self.env.members[i] for i in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        """Return that nothing is wrapped."""
        return [False for _ in self._get_indices(indices)]

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Start the next `reset` with episode `seed`, and the environment behind it with the next one each."""
        self._first = seed
        return [None if seed is None else seed + i for i in range(self.num_envs)]
