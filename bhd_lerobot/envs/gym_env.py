"""One simulation as a Gymnasium environment."""

from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.envs import register  # noqa: F401  registers the environments
from bhd_lerobot.envs.course import STREAM, Course
from bhd_lerobot.envs.settings import make_settings
from bhd_lerobot.envs.spaces import ActionScale, observation_space
from bhd_lerobot.envs.stage import EVENT_NAMES, ClosedError, ResetNeededError, Seen, Stage
from bhd_lerobot.errors import ConfigError, unknown_name
from bhd_lerobot.tasks.task import Event, Outcome, Split

RENDER_MODES = ("rgb_array",)
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
        stage: simulation and task.
        course: which episode comes next.
        task: name of the environment.

    Args:
        environment: the environment's name, such as ``"TurtleBot3Avoid-v0"``.
        robot: options of the robot that differ from their defaults, by name, or its configuration.
        task: the same of the task.
        seed: the run's seed.
        split: `train`, `validation` or `held_out`: which set of episodes.
        cameras: whether the robot's cameras are observed.
        obs_type: what an observation holds: one of `settings.OBS_TYPES`; all that there is if None.
        normalise_actions: take actions in [-1, 1], mapped to the bounds.
        render_mode: ``"rgb_array"`` or None.
        first_episode: number of the first episode, if `reset` gets none; drawn at random below 2**32 if None.
        episode_stride: how many episodes further the next one is.

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
        seed: int = 0,
        split: Split = "train",
        cameras: bool | None = None,
        obs_type: str | None = None,
        normalise_actions: bool = False,
        render_mode: str | None = None,
        first_episode: int | None = None,
        episode_stride: int = STREAM,
    ) -> None:
        settings = make_settings(environment, robot, task, cameras=cameras, obs_type=obs_type)
        self.render_mode = check_render_mode(render_mode)
        self.course = Course(seed, split, first_episode, episode_stride)
        self.stage = Stage(settings.robot, settings.task)
        self.task = settings.name
        self.metadata = {**self.metadata, "render_fps": settings.robot.fps}
        self._scale = ActionScale(self.stage.simulation, normalise=normalise_actions)
        self.action_space = self._scale.space
        self.observation_space = observation_space(self.stage.simulation, self.stage.task, settings.parts)
        self._closed = False

    @property
    def task_description(self) -> str:
        """The instruction of this episode."""
        return self.stage.instruction(0)

    @property
    def _max_episode_steps(self) -> int:
        """Longest duration of an episode [frames]; LeRobot asks for it by this name."""
        return self.stage.frames

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observation, dict]:
        """Start an episode.

        Args:
            seed: the episode's number in the run; the next one if None.
            options: none are known; any are ignored, as LeRobot passes its own.

        Raises:
            ClosedError: the environment was closed.
        """
        self._check_open()
        super().reset(seed=seed)
        self.stage.reset(_FIRST, [self.course.advance(seed)])
        return self._observe(), self._info(Event.NOTHING)

    def step(self, action: NDArray[np.float32]) -> tuple[Observation, float, bool, bool, dict]:
        """Let one frame go by; return observation, reward, terminated, truncated and info.

        Args:
            action: shape (a,).

        Raises:
            ActionError: an action of another shape, or one that is not finite.
            ResetNeededError: no episode was started, or it is over.
            ClosedError: the environment was closed.
        """
        self._check_open()
        if not self.stage.running[0]:
            raise ResetNeededError("No episode is running; call reset() first, and again after each episode's end.")
        stepped = self.stage.step(self._scale.to_robot(np.asarray(action)[None], self.stage.running))
        event = Event(int(stepped.event[0]))
        observation, info = self._observe(), self._info(event)
        if event != Event.NOTHING:
            self.stage.rest(_FIRST)
            outcome = self.stage.outcome(0, event)
            info |= end_info(outcome)
        return observation, float(stepped.reward[0]), bool(stepped.terminated[0]), bool(stepped.truncated[0]), info

    def render(self) -> NDArray[np.uint8] | None:
        """Return the scene from outside, shape (height, width, 3); None without a render mode.

        Raises:
            RenderingError: no image can be rendered here.
        """
        self._check_open()
        return None if self.render_mode is None else self.stage.render(0)

    def close(self) -> None:
        """Free the simulation. May be called twice."""
        if not self._closed:
            self._closed = True
            self.stage.close()

    def _observe(self) -> Observation:
        observation = batched(self.stage.observe(), self.observation_space)
        return {
            key: {name: image[0] for name, image in value.items()} if isinstance(value, dict) else value[0]
            for key, value in observation.items()
        }

    def _info(self, event: Event) -> dict[str, Any]:
        return {
            "is_success": False,
            "event": EVENT_NAMES[event],
            "episode_index": self.course.episode,
            "seed": int(self.stage.seeds[0]),
        }

    def _check_open(self) -> None:
        if self._closed:
            raise ClosedError(f"The environment {self.task!r} was closed; make a new one.")


_FIRST = np.zeros(1, np.intp)


def batched(seen: Seen, space: Any) -> dict[str, Any]:
    """Return what was seen as observations of a batch, with the keys of the space of a single one."""
    parts = {"agent_pos": seen.state, "environment_state": seen.environment_state, "pixels": seen.images}
    return {key: parts[key] for key in space}


def end_info(outcome: Outcome) -> dict[str, Any]:
    """Return what the info of an episode's last step says besides."""
    return {"is_success": outcome.success, "score": float(outcome.score), "details": dict(outcome.details)}


def check_render_mode(render_mode: str | None) -> str | None:
    """Return the render mode if there is such a one."""
    if render_mode is not None and render_mode not in RENDER_MODES:
        raise ConfigError(unknown_name("render_mode", render_mode, RENDER_MODES))
    return render_mode
