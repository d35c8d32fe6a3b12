"""n simulations as one Gymnasium vector environment, in one process, on MuJoCo's thread pool."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from bhd_lerobot.envs.episodes import EVENT_NAMES, ClosedError, ResetNeededError, SteppedEpisodes
from bhd_lerobot.envs.sequence import STREAM, EpisodeSequence
from bhd_lerobot.envs.settings import make_settings
from bhd_lerobot.envs.spaces import ActionScale, observation_space
from bhd_lerobot.envs.vector_member import Images, Member
from bhd_lerobot.errors import ConfigError, unknown_name
from bhd_lerobot.tasks.task import Event, Split

RENDER_MODES = ("rgb_array",)
# `lerobot-eval` passes this to reset(): it wants one episode of each environment and ignores all that comes after.
_ONE_EPISODE = "lerobot_new_rollout"


class BhdVectorEnv(VectorEnv[dict[str, Any], NDArray[np.float32], NDArray[Any]]):
    """n robots with a task each, as a Gymnasium vector environment.

    The same seeds and actions give the same as n `BhdEnv` in Gymnasium's `SyncVectorEnv`, bit for bit: observations,
    rewards, ends and infos. Both of Gymnasium's autoreset modes are supported, and none.

    Environment i starts with episode i of the run, and `reset(seed=k)` starts episodes k to k + n - 1. Each goes on as
    a `BhdEnv` does: no two run the same episode.

    Attributes:
        episodes: simulations and task.
        members: what `call`, `get_attr` and `set_attr` talk to, one for each environment.

    Args:
        num_envs: how many.
        environment: the environment's name, such as ``"TurtleBot3Avoid-v0"``.
        robot: options of the robot that differ from their defaults, by name, or its configuration.
        task: the same of the task.
        seed: the run's seed.
        split: `train`, `validation` or `held_out`: which set of episodes.
        cameras: whether the robots' cameras are observed.
        obs_type: what an observation holds: one of `settings.OBS_TYPES`; all that there is if None.
        normalise_actions: take actions in [-1, 1], mapped to the bounds.
        render_mode: ``"rgb_array"`` or None.
        autoreset_mode: when an environment whose episode is over starts the next.
        first_episode: number of the first environment's first episode, if `reset` gets none; each draws its own
            at random below 2**32 if None.
        episode_stride: how many episodes further an environment's next one is.
        threads: threads that step the physics; all processors if None.

    Raises:
        ConfigError: a name or a value that cannot be honoured.
    """

    def __init__(
        self,
        num_envs: int,
        environment: str,
        robot: Any = None,
        task: Any = None,
        *,
        seed: int = 0,
        split: Split = "train",
        cameras: bool | None = None,
        obs_type: str | None = None,
        normalise_actions: bool = False,
        render_mode: str | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        first_episode: int | None = 0,
        episode_stride: int = STREAM,
        threads: int | None = None,
    ) -> None:
        if isinstance(num_envs, bool) or not isinstance(num_envs, int) or num_envs < 1:
            raise ConfigError(f"num_envs is {num_envs!r}; it must be a whole number of at least 1.")
        settings = make_settings(environment, robot, task, cameras=cameras, obs_type=obs_type)
        if render_mode is not None and render_mode not in RENDER_MODES:
            raise ConfigError(unknown_name("render_mode", render_mode, RENDER_MODES))
        self.render_mode = render_mode
        self.autoreset_mode = _autoreset_mode(autoreset_mode)
        self.num_envs = n = num_envs
        self.episodes = SteppedEpisodes(settings.robot, settings.task, n, threads)
        self.task = settings.name
        firsts = [None if first_episode is None else first_episode + i for i in range(n)]
        sequences = [EpisodeSequence(seed, split, first, episode_stride) for first in firsts]
        self.members = [Member(self.episodes, i, sequence, self) for i, sequence in enumerate(sequences)]
        self.metadata = {
            "render_modes": list(RENDER_MODES),
            "render_fps": settings.robot.fps,
            "autoreset_mode": self.autoreset_mode,
        }
        self._scale = ActionScale(self.episodes.simulation, normalise=normalise_actions)
        self.single_action_space = self._scale.space
        self.single_observation_space = observation_space(self.episodes.simulation, self.episodes.task, settings.parts)
        self.action_space = batch_space(self.single_action_space, n)
        self.observation_space = batch_space(self.single_observation_space, n)
        self._all = np.arange(n)
        self._observation: dict[str, Any] | None = None  # the last one; what is handed out is never written to again
        self._one_episode = False
        self._episodes = np.full(n, -1, np.int64)
        self._over: NDArray[np.bool_] = np.zeros(n, np.bool_)
        self._terminated: NDArray[np.bool_] = self._over.copy()
        self._truncated: NDArray[np.bool_] = self._over.copy()
        self._success = self._over.copy()
        self._event: NDArray[np.int64] = np.zeros(n, np.int64)

    # --- Gymnasium's interface ---------------------------------------------------------------------------------------

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Start episodes.

        Args:
            seed: number of the first environment's episode, the others' follow; or a number for each, None for the
                next one.
            options: `reset_mask`: only these environments, shape (n,). LeRobot's mark of a new rollout: an environment
                whose episode is over is left alone until the next `reset` and repeats its last step, with reward 0,
                because LeRobot ignores what comes after.

        Raises:
            ConfigError: the seeds or the mask do not fit.
            ClosedError: the environment was closed.
        """
        self._check_open()
        numbers = self._episode_numbers(seed)
        options = options or {}
        ids: NDArray[np.intp] = self._all
        if "reset_mask" in options:
            mask = np.asarray(options["reset_mask"])
            if mask.shape != (self.num_envs,) or mask.dtype != np.bool_ or not mask.any():
                raise ConfigError(f"reset_mask is {mask!r}; it must be {self.num_envs} booleans, one of them true.")
            ids = np.flatnonzero(mask)
            if self._observation is None and len(ids) < self.num_envs:
                raise ResetNeededError("No episode is running; call reset() without a mask first.")
        self._one_episode = bool(options.get(_ONE_EPISODE))
        super().reset(seed=seed if isinstance(seed, int) else None)
        self._start(ids, [numbers[sim] for sim in ids])
        self._see(ids)
        return self._observations(), self._infos(only=None if len(ids) == self.num_envs else ids)

    def step(
        self, actions: NDArray[np.float32]
    ) -> tuple[dict[str, Any], NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Let one frame go by.

        Args:
            actions: shape (n, a).

        Returns:
            Observations, rewards, shape (n,), terminated, truncated, shape (n,), and infos.

        Raises:
            ActionError: actions of another shape, or one that is not finite.
            ResetNeededError: an environment is in no episode.
            ClosedError: the environment was closed.
        """
        self._check_open()
        if self._observation is None:
            raise ResetNeededError("No episode is running; call reset() first.")
        if self.autoreset_mode == AutoresetMode.DISABLED and self._over.any() and not self._one_episode:
            raise ResetNeededError(
                f"The episodes of environments {np.flatnonzero(self._over).tolist()} are over and autoreset_mode is "
                "DISABLED; call reset() first, of some of several with options={'reset_mask': …}."
            )
        over = np.flatnonzero(self._over)
        values = self._scale.to_robot(actions, self.episodes.running)
        reward: NDArray[np.float64] = np.zeros(self.num_envs)
        ended = over[:0]
        if len(over) < self.num_envs:
            stepped = self.episodes.step(values)
            reward = stepped.reward
            if self._one_episode:
                for kept, new in (
                    (self._terminated, stepped.terminated),
                    (self._truncated, stepped.truncated),
                    (self._event, stepped.event),
                ):
                    np.copyto(kept, new, where=self.episodes.running)
            else:
                self._terminated, self._truncated, self._event = stepped.terminated, stepped.truncated, stepped.event
            ended = np.flatnonzero(stepped.event)
        elif not self._one_episode:
            for flags in (self._terminated, self._truncated, self._event):
                flags[:] = 0
        if not self._one_episode:
            self._success[:] = False
            if len(over):
                # Those whose episodes ended a step ago take no action: they begin anew.
                self._start(over, [None] * len(over))
        self._see(np.flatnonzero(self.episodes.running))
        return self._end(ended, reward)

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Return each scene from outside, shape (height, width, 3); None without a render mode.

        Raises:
            RenderingError: no image can be rendered here.
        """
        self._check_open()
        return None if self.render_mode is None else tuple(map(self.episodes.render, range(self.num_envs)))

    def call(self, name: str, *args: Any, **kwargs: Any) -> Sequence[Any]:
        """Call a method of each environment, or get an attribute; see `Member`."""
        self._check_open()
        if name == "render" and not args and not kwargs and self.render_mode is not None:
            return Images(self.episodes)  # LeRobot takes the first few of them only
        values = [getattr(member, name) for member in self.members]
        return tuple(value(*args, **kwargs) if callable(value) else value for value in values)

    def get_attr(self, name: str) -> Sequence[Any]:
        """Return an attribute of each environment; see `Member`."""
        return self.call(name)

    def set_attr(self, name: str, values: Any) -> None:
        """Set an attribute of the environments, `seed` or `split` of their sequences for example.

        Args:
            name: the attribute.
            values: a list or tuple with a value for each, or one for all.

        Raises:
            ConfigError: another number of values, or there is no such attribute.
        """
        if not isinstance(values, list | tuple):
            values = [values] * self.num_envs
        if len(values) != self.num_envs:
            raise ConfigError(f"There are {len(values)} values for {self.num_envs} environments.")
        for member, value in zip(self.members, values, strict=True):
            member.set(name, value)

    def close_extras(self, **kwargs: Any) -> None:
        """Free the simulations."""
        self.episodes.close()

    # --- episodes ----------------------------------------------------------------------------------------------------

    def _start(self, ids: NDArray[np.intp], numbers: Sequence[int | None]) -> None:
        """Start episodes in some environments; of these numbers, or the next ones."""
        sequences = [self.members[sim].sequence for sim in ids]
        self.episodes.reset(
            ids, [sequence.advance(number) for sequence, number in zip(sequences, numbers, strict=True)]
        )
        self._episodes[ids] = [sequence.episode for sequence in sequences]
        for flags in (self._over, self._terminated, self._truncated, self._success):
            flags[ids] = False
        self._event[ids] = Event.NOTHING

    def _end(self, ended: NDArray[np.intp], reward: NDArray[np.float64]) -> tuple[Any, Any, Any, Any, Any]:
        """Finish a step in which some episodes ended; return what `step` returns."""
        if not len(ended):
            return self._observations(), reward, self._terminated.copy(), self._truncated.copy(), self._infos()
        outcomes = [self.episodes.outcome(sim, Event(int(self._event[sim]))) for sim in ended.tolist()]
        self._success[ended] = [outcome.success for outcome in outcomes]
        finals = [
            {
                "event": EVENT_NAMES[self._event[sim]],
                "episode_index": int(self._episodes[sim]),
                "seed": int(self.episodes.seeds[sim]),
                "is_success": outcome.success,
                "score": float(outcome.score),
                "details": dict(outcome.details),
            }
            for sim, outcome in zip(ended.tolist(), outcomes, strict=True)
        ]
        terminated, truncated = self._terminated.copy(), self._truncated.copy()
        infos: dict[str, Any] = {}
        self.episodes.rest(ended)
        self._over[ended] = True
        if self.autoreset_mode == AutoresetMode.SAME_STEP:
            for sim, final in zip(ended.tolist(), finals, strict=True):
                infos = self._add_info(infos, {"final_obs": self._single(sim), "final_info": final}, sim)
            if not self._one_episode:
                self._start(ended, [None] * len(ended))
                self._see(ended)
            infos |= self._infos()
        else:
            infos = self._infos()
            for sim, final in zip(ended.tolist(), finals, strict=True):
                infos = self._add_info(infos, {key: final[key] for key in ("score", "details")}, sim)
        return self._observations(), reward, terminated, truncated, infos

    def _see(self, ids: NDArray[np.intp]) -> None:
        """Observe some environments; those that are over keep what they saw last."""
        if not len(ids):
            return
        everything = len(ids) == self.num_envs
        running = np.count_nonzero(self.episodes.running)
        seen = self.episodes.observe(None if len(ids) == running else ids)
        parts: Any = self.single_observation_space
        new = {key: seen[key] for key in parts}
        if everything or self._observation is None:
            self._observation = new
            return
        self._observation = _merged(self._observation, new, ids)

    def _observations(self) -> dict[str, Any]:
        if self._observation is None:
            raise AssertionError("Nothing was observed yet.")
        return dict(self._observation)

    def _single(self, sim: int) -> dict[str, Any]:
        """Return one environment's observation, a copy."""
        return {
            key: {name: image[sim].copy() for name, image in value.items()}
            if isinstance(value, dict)
            else value[sim].copy()
            for key, value in self._observations().items()
        }

    def _infos(self, only: NDArray[np.intp] | None = None) -> dict[str, Any]:
        n = self.num_envs
        infos = {
            "is_success": self._success.copy(),
            "event": EVENT_NAMES[self._event],
            "episode_index": self._episodes.copy(),
            "seed": self.episodes.seeds.copy(),
        }
        mask = np.ones(n, np.bool_)
        if only is not None:
            mask[:] = False
            mask[only] = True
            infos["event"][~mask] = None
            for key in ("is_success", "episode_index", "seed"):
                infos[key][~mask] = 0
        return infos | {f"_{key}": mask.copy() for key in infos}

    def _episode_numbers(self, seed: int | Sequence[int | None] | None) -> list[int | None]:
        if seed is None:
            return [None] * self.num_envs
        numbers: list[int | None] = list(range(seed, seed + self.num_envs)) if isinstance(seed, int) else list(seed)
        if len(numbers) != self.num_envs:
            raise ConfigError(f"There are {len(numbers)} seeds for {self.num_envs} environments.")
        return numbers

    def _check_open(self) -> None:
        if self.closed:
            raise ClosedError(f"The environment {self.task!r} was closed; make a new one.")


def _merged(old: Mapping[str, Any], new: Mapping[str, Any], ids: NDArray[np.intp]) -> dict[str, Any]:
    """Return observations with some rows replaced; neither is written to."""
    merged: dict[str, Any] = {}
    for key, value in old.items():
        if isinstance(value, dict):
            merged[key] = _merged(value, new[key], ids)
        else:
            merged[key] = value.copy()
            merged[key][ids] = new[key][ids]
    return merged


def info_of(infos: dict[str, Any], sim: int) -> dict[str, Any]:
    """Return what a vector environment reports of one environment, as plain values."""
    found = {}
    for key, values in infos.items():
        if not key.startswith("_") and infos[f"_{key}"][sim]:
            value = values[sim] if not isinstance(values, dict) else info_of(values, sim)
            found[key] = value.item() if isinstance(value, np.generic) else value
    return found


def _autoreset_mode(mode: AutoresetMode | str) -> AutoresetMode:
    try:
        return AutoresetMode(mode)
    except ValueError:
        raise ConfigError(unknown_name("autoreset_mode", mode, [one.value for one in AutoresetMode])) from None
