"""The environments as LeRobot's environment type `bhd`."""

import multiprocessing
from contextlib import closing
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Any

import gymnasium
from gymnasium import spaces
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_IMAGES, OBS_STATE

from bhd_lerobot.envs.register import NAMESPACE
from bhd_lerobot.envs.sequence import EpisodeSequence
from bhd_lerobot.envs.settings import Settings, make_settings
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.options.declared import Count, OneOf, check_options

if TYPE_CHECKING:  # LeRobot's commands import this module, whatever they are used for
    from bhd_lerobot.envs.gym_env import BhdEnv

VECTORS = ("bhd", "sync", "async")


@EnvConfig.register_subclass("bhd")
@dataclass
class BhdEnvConfig(EnvConfig):
    """Environments of this package for `lerobot-eval` and `lerobot-train`: ``--env.type=bhd --env.task=…``.

    Attributes:
        task: the environment's name, such as ``TurtleBot3Avoid-v0``, with or without its namespace.
        fps: actions a second [Hz]; the robot's own if 0.
        robot: options of the robot that differ from their defaults, by name: ``--env.robot='{beams: 36}'``.
        task_options: options of the task that differ from their defaults, by name.
        seed: the run's seed; seed k of an evaluation is episode k of this run.
        split: `held_out`, `validation` or `train`: which set of episodes; `bhd-train` takes `validation` in place of
            `held_out`.
        cameras: whether the robot's cameras are observed; the robot's own option if None.
        obs_type: what an observation holds: `state`, `pixels`, `pixels_agent_pos` or
            `pixels_environment_state_agent_pos`; all that there is if None.
        vector: how several run side by side: `bhd` (ours, in one process), or Gymnasium's `sync` or `async`.
        threads: with `bhd`, threads that step the physics; all processors if None.
        render_mode: ``rgb_array``, for the videos.
        features: what a policy gets and gives; follows from the rest.
        features_map: LeRobot's names of these; follows from the rest.
    """

    task: str | None = "TurtleBot3Avoid-v0"
    fps: int = 0
    robot: dict[str, Any] = field(default_factory=dict)
    task_options: dict[str, Any] = field(default_factory=dict)
    seed: int = 0
    split: str = "held_out"
    cameras: bool | None = None
    obs_type: str | None = None
    vector: Annotated[str, OneOf(VECTORS)] = "bhd"
    threads: Count | None = None
    render_mode: str = "rgb_array"

    def __post_init__(self) -> None:
        """Refuse what cannot be honoured, and work out the features."""
        check_options(self, "env.")
        from bhd_lerobot.envs.gym_env import BhdEnv

        EpisodeSequence(self.seed, self.split)  # type: ignore[arg-type]
        self.fps = self._settings().robot.fps
        with closing(BhdEnv(self.gym_id, **self.gym_kwargs)) as env:
            self._add_features(env)

    @property
    def package_name(self) -> str:
        """The package that registers the environments."""
        return NAMESPACE

    @property
    def gym_id(self) -> str:
        """The environment's full name."""
        return f"{NAMESPACE}/{self._settings().name}"

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """The arguments of `BhdEnv`, besides the environment's name and its place among others."""
        return {
            "robot": {**self.robot, "fps": self.fps},
            "task": dict(self.task_options),
            "seed": self.seed,
            "split": self.split,
            "cameras": self.cameras,
            "obs_type": self.obs_type,
            "render_mode": self.render_mode,
        }

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, VectorEnv]]:
        """Return n environments in LeRobot's form; `vector` states how they run, whatever `use_async_envs` is."""
        if n_envs < 1:
            raise ConfigError(f"The number of environments (eval.batch_size) is {n_envs}; it must be at least 1.")
        mode = AutoresetMode.SAME_STEP
        vector: VectorEnv
        if self.vector == "bhd":
            from bhd_lerobot.envs.vector import BhdVectorEnv

            name = self._settings().name
            vector = BhdVectorEnv(n_envs, name, **self.gym_kwargs, autoreset_mode=mode, threads=self.threads)
        else:
            makers = [_Maker(self, i) for i in range(n_envs)]
            if self.vector == "sync":
                vector = SyncVectorEnv(makers, autoreset_mode=mode)
            else:
                # What is imported before the processes part need not be imported in each.
                multiprocessing.set_forkserver_preload(["__main__", __name__, "bhd_lerobot.envs.gym_env"])
                vector = AsyncVectorEnv(makers, context="forkserver", autoreset_mode=mode)
        return {self.type: {0: vector}}

    def _settings(self) -> Settings:
        given = self.robot.get("fps", self.fps)
        if self.fps and given != self.fps:
            raise ConfigError(
                f"env.fps is {self.fps} and env.robot.fps is {given}; leave env.robot.fps out, "
                "the robot acts at env.fps."
            )
        robot = {**self.robot, "fps": given} if given else self.robot
        return make_settings(self.task or "", robot, self.task_options, cameras=self.cameras, obs_type=self.obs_type)

    def _add_features(self, env: "BhdEnv") -> None:
        self.features = {ACTION: PolicyFeature(FeatureType.ACTION, env.action_space.shape or ())}
        self.features_map = {ACTION: ACTION}
        keys = {"agent_pos": (FeatureType.STATE, OBS_STATE), "environment_state": (FeatureType.ENV, OBS_ENV_STATE)}
        space: Any = env.observation_space
        for key, part in space.items():
            if isinstance(part, spaces.Dict):
                for camera, image in part.items():
                    self.features[f"{key}/{camera}"] = PolicyFeature(FeatureType.VISUAL, image.shape or ())
                    self.features_map[f"{key}/{camera}"] = f"{OBS_IMAGES}.{camera}"
            else:
                kind, self.features_map[key] = keys[key]
                self.features[key] = PolicyFeature(kind, part.shape)


class _Maker:
    """Makes one of n environments, in whatever process it is called."""

    def __init__(self, config: BhdEnvConfig, first: int) -> None:
        self._name = config.gym_id
        self._kwargs = {**config.gym_kwargs, "first_episode": first}

    def __call__(self) -> gymnasium.Env:
        from bhd_lerobot.envs.gym_env import BhdEnv

        return BhdEnv(self._name, **self._kwargs)
