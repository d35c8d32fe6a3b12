"""Configuration of reinforcement learning, and how `bhd-train` recognises it."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lerobot.robots.config import RobotConfig

from bhd_lerobot.envs.register import ENVIRONMENTS
from bhd_lerobot.errors import ConfigError, unknown_name
from bhd_lerobot.rollout import configuration
from bhd_lerobot.rollout.registry import robot_of_task
from bhd_lerobot.tasks.task import TaskConfig
from bhd_lerobot.training.rl.sections import (
    EVENTS,
    POTENTIALS,
    SCHEDULES,
    SELECTIONS,
    AnchorConfig,
    PpoConfig,
    RewardConfig,
    RlEnvConfig,
    RlPolicyConfig,
    ValidationConfig,
)

ALGORITHMS = ("ppo",)
CONFIG_NAME = "config.yaml"


@dataclass
class RlConfig:
    """Learn by trial and error: PPO of stable-baselines3 on many simulations side by side, into a `bhd_mlp`.

    Attributes:
        robot: the robot, in simulation.
        task: what it is to achieve.
        algorithm: ``"ppo"``.
        env: the environments.
        policy: the actor.
        ppo: the algorithm.
        reward: what the learner gets.
        validation: how it is judged on the way.
        anchor: what keeps it near `start_from`.
        steps: environment steps, all environments together.
        max_minutes: end after this time [min], validation included; nothing: after `steps` only.
        start_from: a checkpoint of a `bhd_mlp`, whose weights become the actor.
        start_action: which action of the checkpoint's chunk becomes the actor's, from 0. A later one asks at once for
            what the checkpoint would ask for some frames later, and so hurries.
        see_ignored: let the actor see what the checkpoint ignores (`policy.ignore`); it begins as if it did not. A
            clone must not see its own speed, because it would repeat it; who learns from what comes of it may.
        critic_warmup: environment steps in which only the critic learns.
        output_dir: folder of the run; a new one in `outputs/train` if nothing.
        resume: go on with the run in `output_dir`.
        seed: of everything that is random.
        threads: threads of torch; its own choice if nothing.
    """

    robot: RobotConfig
    task: TaskConfig
    algorithm: str = "ppo"
    env: RlEnvConfig = field(default_factory=RlEnvConfig)
    policy: RlPolicyConfig = field(default_factory=RlPolicyConfig)
    ppo: PpoConfig = field(default_factory=PpoConfig)
    reward: RewardConfig = field(default_factory=RewardConfig)
    validation: ValidationConfig = field(default_factory=ValidationConfig)
    anchor: AnchorConfig = field(default_factory=AnchorConfig)
    steps: int = 1_000_000
    max_minutes: float | None = None
    start_from: str | None = None
    start_action: int = 0
    see_ignored: bool = False
    critic_warmup: int = 0
    output_dir: str | None = None
    resume: bool = False
    seed: int = 0
    threads: int | None = None

    def __post_init__(self) -> None:
        """Refuse values that cannot be honoured.

        Raises:
            ConfigError: names the value and the valid ones.
        """
        self._check_names()
        self._check_numbers()
        _ = self.policy.actor()
        if self.robot.type != robot_of_task(self.task):
            raise ConfigError(f"robot.type is {self.robot.type!r}; this task is for {robot_of_task(self.task)!r}.")
        if self.validation.seed == self.seed:
            raise ConfigError(
                f"validation.seed and seed are both {self.seed}; the policy would be judged on the episodes that it "
                "learned from. Set another --validation.seed."
            )
        if self.start_from is None:
            for name, asked in (("anchor.coef", self.anchor.coef), ("critic_warmup", self.critic_warmup)):
                if asked:
                    raise ConfigError(f"{name} is {asked}; it needs --start_from, a checkpoint to stay near.")
            if self.see_ignored:
                raise ConfigError("see_ignored is true; it needs --start_from, a checkpoint that ignores something.")
        if self.policy.scan.channels and self.policy.scan.transform == "none":
            raise ConfigError("policy.scan.channels needs policy.scan.transform: inverse or log.")
        if self.resume and self.output_dir is None:
            raise ConfigError("resume needs --output_dir, or --config_path with the config.yaml of the run.")

    @property
    def environment(self) -> str:
        """Name of the environment of this robot and task."""
        task = self.task.get_choice_name(type(self.task))
        return next(name for name, pair in ENVIRONMENTS.items() if pair == (self.robot.type, task))

    def _check_names(self) -> None:
        for name, value, valid in (
            ("algorithm", self.algorithm, ALGORITHMS),
            ("ppo.lr_schedule", self.ppo.lr_schedule, SCHEDULES),
            ("reward.potential", self.reward.potential, POTENTIALS),
            ("validation.select", self.validation.select, SELECTIONS),
            *(("event in reward.events", event, EVENTS) for event in self.reward.events),
        ):
            if value not in valid:
                raise ConfigError(unknown_name(name, value, valid))
        if self.reward.potential == "pose" and "ur5" not in self.robot.type:
            raise ConfigError("reward.potential is 'pose'; only a task with a target pose of the tool has it (reach).")

    def _check_numbers(self) -> None:
        ppo, validation = self.ppo, self.validation
        for name, value, least in (
            ("steps", self.steps, 1),
            ("env.n_envs", self.env.n_envs, 1),
            ("env.threads", 1 if self.env.threads is None else self.env.threads, 1),
            ("threads", 1 if self.threads is None else self.threads, 1),
            ("ppo.n_steps", ppo.n_steps, 2),
            ("ppo.batch_size", ppo.batch_size, 2),
            ("ppo.n_epochs", ppo.n_epochs, 1),
            ("validation.freq", validation.freq, 1),
            ("validation.n_episodes", validation.n_episodes, 1),
            ("validation.n_envs", validation.n_envs, 1),
            ("validation.seed", validation.seed, 0),
            ("anchor.batch_size", self.anchor.batch_size, 1),
            ("critic_warmup", self.critic_warmup, 0),
            ("start_action", self.start_action, 0),
            ("seed", self.seed, 0),
            *(("policy.critic_dims", width, 1) for width in self.policy.critic_dims),
        ):
            if value < least:
                raise ConfigError(f"{name} is {value}; it must be at least {least}.")
        for name, number in (("ppo.gamma", ppo.gamma), ("ppo.gae_lambda", ppo.gae_lambda)):
            if not 0 <= number <= 1:
                raise ConfigError(f"{name} is {number}; it must be between 0 and 1.")
        for name, number in (
            ("ppo.lr", ppo.lr),
            ("ppo.clip_range", ppo.clip_range),
            ("ppo.max_grad_norm", ppo.max_grad_norm),
            ("ppo.target_kl", 1.0 if ppo.target_kl is None else ppo.target_kl),
            ("reward.scale", self.reward.scale),
        ):
            if not 0 < number < math.inf:
                raise ConfigError(f"{name} is {number}; it must be positive and finite.")
        for name, number in (
            ("ppo.ent_coef", ppo.ent_coef),
            ("ppo.vf_coef", ppo.vf_coef),
            ("reward.per_m", self.reward.per_m),
            ("reward.per_rad", self.reward.per_rad),
            ("anchor.coef", self.anchor.coef),
        ):
            if not 0 <= number < math.inf:
                raise ConfigError(f"{name} is {number}; it must be 0 or positive, and finite.")
        for name, number in (
            ("ppo.log_std_init", ppo.log_std_init or 0.0),
            ("reward.frame", self.reward.frame),
            *((f"reward.events.{event}", number) for event, number in self.reward.events.items()),
        ):
            if not math.isfinite(number):
                raise ConfigError(f"{name} is {number}; it must be a finite number.")
        if self.max_minutes is not None and not self.max_minutes > 0:
            raise ConfigError(f"max_minutes is {self.max_minutes}; it must be positive.")


def is_rl(arguments: Sequence[str]) -> bool:
    """Tell whether a command line of `bhd-train` asks for reinforcement learning: `algorithm` is set in it.

    What is wrong with the command line is left to the parser that reads it next.
    """
    try:
        overrides = configuration.read_overrides(arguments)
        if "algorithm" in overrides:
            return True
        path = overrides.get(configuration.CONFIG_PATH)
        file = None if path is None else _config_file(Path(str(path)))
        return file is not None and file.suffix != ".json" and "algorithm" in configuration.read_file(file)
    except ConfigError:
        return False


def parse_rl(arguments: Sequence[str]) -> RlConfig:
    """Return what a command line asks for.

    Args:
        arguments: `--config_path=FILE` and overrides; to resume, FILE may be the run's folder.

    Raises:
        ConfigError: an unknown key, a value of the wrong type or out of range, or a file that cannot be read.
    """
    prefix = f"--{configuration.CONFIG_PATH}="
    found = [
        f"{prefix}{_config_file(Path(one.removeprefix(prefix)))}" if one.startswith(prefix) else one
        for one in arguments
    ]
    return configuration.parse(RlConfig, found)


def encode(config: RlConfig) -> dict[str, Any]:
    """Return a configuration as plain values."""
    return configuration.encode(config)


def _config_file(path: Path) -> Path:
    return path / CONFIG_NAME if path.is_dir() else path
