"""One simulation as a Gymnasium environment: the vector environment of one."""

from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.envs import register  # noqa: F401  registers the environments
from bhd_lerobot.envs.sequence import EpisodeSequence
from bhd_lerobot.envs.vector import RENDER_MODES, BhdVectorEnv, info_of

Observation = dict[str, Any]


class BhdEnv(gymnasium.Env[Observation, NDArray[np.float32]]):
    """A robot with a task, as a Gymnasium environment.

    One step is one frame: the action goes to the cerebellum, which controls the robot at its own rate meanwhile.
    Observation: `agent_pos`, `environment_state` and `pixels`, LeRobot's names, as far as there are any. Action: the
    robot's action features, in SI units. `reset(seed=k)` starts episode k of the run `seed`; each `reset()` after it
    continues to an episode that no other seed below 2**32 leads to.

    An episode is terminated by what happens in it and truncated by the end of its time. `info` holds `is_success`,
    `event`, `episode_index` and `seed` (the episode's), and at the end `score` and the task's `details`.

    Attributes:
        episodes: simulation and task.
        task: name of the environment.

    Args:
        environment: the environment's name, such as ``"TurtleBot3Avoid-v0"``.
        robot: options of the robot that differ from their defaults, by name, or its configuration.
        task: the same of the task.
        render_mode: ``"rgb_array"`` or None.
        first_episode: number of the first episode, if `reset` gets none; drawn at random below 2**32 if None.
        options: others of `BhdVectorEnv`, but for `autoreset_mode`.

    Raises:
        ConfigError: a name or a value that cannot be honoured.
    """

    metadata = {"render_modes": list(RENDER_MODES), "render_fps": 10}  # noqa: RUF012  Gymnasium's own form

    def __init__(
        self,
        environment: str,
        robot: Any = None,
        task: Any = None,
        *,
        render_mode: str | None = None,
        first_episode: int | None = None,
        **options: Any,
    ) -> None:
        options |= {"render_mode": render_mode, "first_episode": first_episode, "autoreset_mode": "Disabled"}
        self._one = BhdVectorEnv(1, environment, robot, task, **options)
        self.render_mode, self.task, self.episodes = render_mode, self._one.task, self._one.episodes
        self.metadata = {**self.metadata, "render_fps": self._one.metadata["render_fps"]}
        self.action_space = self._one.single_action_space
        self.observation_space = self._one.single_observation_space

    @property
    def sequence(self) -> EpisodeSequence:
        """Which episode comes next."""
        return self._one.members[0].sequence

    @property
    def task_description(self) -> str:
        """The instruction of this episode."""
        return self.episodes.instruction(0)

    @property
    def _max_episode_steps(self) -> int:
        """Longest duration of an episode [frames]; LeRobot asks for it by this name."""
        return self.episodes.frames

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observation, dict]:
        """Start an episode.

        Args:
            seed: the episode's number in the run; the next one if None.
            options: none are known; any are ignored, as LeRobot passes its own.

        Raises:
            ClosedError: the environment was closed.
        """
        observation, info = self._one.reset(seed=[seed])
        super().reset(seed=seed)
        return _first(observation), info_of(info, 0)

    def step(self, action: NDArray[np.float32]) -> tuple[Observation, float, bool, bool, dict]:
        """Let one frame go by; return observation, reward, terminated, truncated and info.

        Args:
            action: shape (a,).

        Raises:
            ActionError: an action of another shape, or one that is not finite.
            ResetNeededError: no episode was started, or it is over.
            ClosedError: the environment was closed.
        """
        observation, reward, terminated, truncated, info = self._one.step(np.asarray(action)[None])
        return _first(observation), float(reward[0]), bool(terminated[0]), bool(truncated[0]), info_of(info, 0)

    def render(self) -> NDArray[np.uint8] | None:
        """Return the scene from outside, shape (height, width, 3); None without a render mode.

        Raises:
            RenderingError: no image can be rendered here.
        """
        images = self._one.render()
        return None if images is None else images[0]

    def close(self) -> None:
        """Free the simulation. May be called twice."""
        self._one.close()


def _first(observation: Observation) -> Observation:
    """Return the first row of everything."""
    return {key: _first(value) if isinstance(value, dict) else value[0] for key, value in observation.items()}
