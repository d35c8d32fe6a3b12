"""Configuration of reinforcement learning, and how `bhd-train` recognises it."""

import copy
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated

from lerobot.robots.config import RobotConfig
from lerobot.utils.constants import CHECKPOINTS_DIR

from bhd_lerobot.envs.register import ENVIRONMENTS
from bhd_lerobot.errors import ConfigError, unknown_name
from bhd_lerobot.options.declared import (
    Count,
    Finite,
    LibrarySeed,
    NotNegative,
    OneOf,
    Options,
    Positive,
    Range,
    Share,
    Whole,
)
from bhd_lerobot.options.parse import CommandLine, parse, read_line
from bhd_lerobot.policies.brain import BrainConfig
from bhd_lerobot.policies.mlp.configuration_mlp import MlpConfig, ScanConfig
from bhd_lerobot.registry import check_task
from bhd_lerobot.tasks.task import TASKS, Event, TaskConfig

# Not among them: that an expert drives ends nothing, and of a failure without a cause only a person says so.
_EVENTS = tuple(event.cause for event in Event if event not in (Event.NOTHING, Event.INTERVENTION, Event.FAILURE))


@dataclass
class RlEnvConfig(Options, prefix="env."):
    """The environments that are learned in.

    Attributes:
        n_envs: how many run side by side.
        threads: threads that step the physics; all processors if not set.
    """

    n_envs: Count = 64
    threads: Count | None = None


@dataclass
class RlPolicyConfig(Options, prefix="policy."):
    """Actor and critic. The actor is a `bhd_mlp`; with `start_from` the checkpoint states which.

    Attributes:
        n_obs_steps: observations that it looks at; a checkpoint's actor with `see_history` only.
        obs_stride: frames from each of them to the next.
        hidden_dims: widths of the hidden layers.
        activation: one of bhd_mlp's.
        layer_norm: normalise each hidden layer before its activation.
        feature_clip: normalised inputs beyond ± this count as this; null turns it off.
        scan: how a range finder's beams become inputs.
        critic_dims: widths of the critic's hidden layers.
        privileged_critic: let the critic see more than the actor, which is all that a robot has: of a base how near the
            scene is, without noise and delay, and what is commanded; how near `avoid` is to calling it stuck, and its
            score so far; whether the collision monitor intervenes.
    """

    n_obs_steps: int = 1
    obs_stride: int = 1
    hidden_dims: list[int] = field(default_factory=lambda: [256, 256])
    activation: str = "tanh"
    layer_norm: bool = False
    feature_clip: float | None = 10.0
    scan: ScanConfig = field(default_factory=ScanConfig)
    critic_dims: list[Count] = field(default_factory=lambda: [256, 256])
    privileged_critic: bool = False

    def actor(self) -> MlpConfig:
        """Return the configuration of an actor that begins from nothing."""
        own = {name: value for name, value in copy.deepcopy(vars(self)).items() if "critic" not in name}
        return MlpConfig(**own, chunk_size=1, n_action_steps=1, gaussian=True, device="cpu", push_to_hub=False)


@dataclass
class PpoConfig(Options, prefix="ppo."):
    """Proximal policy optimisation; the names are those of stable-baselines3.

    Attributes:
        n_steps: frames of each environment between two updates.
        batch_size: samples of a gradient step.
        n_epochs: passes over the samples of an update.
        gamma: discount of a frame.
        gae_lambda: of the generalised advantage estimate.
        clip_range: by how much an update may change an action's probability, as a share.
        ent_coef: weight of the entropy.
        vf_coef: weight of the critic's loss.
        max_grad_norm: largest norm of the gradient.
        lr: learning rate of Adam.
        lr_schedule: ``"linear"``: to 0 over `steps`, whatever time they take; ``"constant"``.
        target_kl: an update ends when the policy has changed by 1.5 times this; null turns it off.
        log_std_init: logarithm of the exploration noise, in normalised actions, the same for all; the mean of the
            checkpoint's own, or 0, if not set.
    """

    n_steps: Annotated[int, Range("[2, inf]")] = 64
    batch_size: Annotated[int, Range("[2, inf]")] = 1024
    n_epochs: Count = 5
    gamma: Share = 0.99
    gae_lambda: Share = 0.95
    clip_range: Positive = 0.2
    ent_coef: NotNegative = 0.0
    vf_coef: NotNegative = 0.5
    max_grad_norm: Positive = 0.5
    lr: Positive = 3e-4
    lr_schedule: Annotated[str, OneOf(("linear", "constant"))] = "linear"
    target_kl: Positive | None = None
    log_std_init: Finite | None = None


@dataclass
class RewardConfig(Options, prefix="reward."):
    """What the learner gets for what the task gives; what is reported is always the task's own reward.

    Attributes:
        scale: factor on the task's reward.
        events: added in the frame that ends with an event, by its name: negative for a failure, positive for a success.
        frame: added in every frame.
        potential: ``"pose"``: potential-based shaping, which leaves the best policy as it is: gamma times the potential
            of the new state minus that of the old one; the potential is minus the distance of the tool from the target
            pose; ``"none"``.
        per_m: weight of the distance in that potential [1/m].
        per_rad: weight of the angle in that potential [1/rad].
    """

    scale: Positive = 1.0
    events: dict[str, Finite] = field(default_factory=dict)
    frame: Finite = 0.0
    potential: Annotated[str, OneOf(("none", "pose"))] = "none"
    per_m: NotNegative = 2.0
    per_rad: NotNegative = 0.5


@dataclass
class ValidationConfig(Options, prefix="validation."):
    """Episodes that judge the policy on the way. They are neither those of the training nor any held-out ones.

    The best checkpoint is the one that was best on them, the policy that the run started with included.

    Attributes:
        freq: environment steps between two validations.
        n_episodes: how many episodes.
        n_envs: how many run side by side.
        seed: run seed of these episodes, of the split `train`; another than the training's.
        select: what makes a checkpoint the best: ``"score"``, ``"success"`` or ``"return"``; of equals, the score.
        rule: a brain whose level is drawn beside the curve; also what normalisation is estimated from. None if not set.
    """

    freq: Count = 200_000
    n_episodes: Count = 64
    n_envs: Count = 64
    seed: Whole = 777_001
    select: Annotated[str, OneOf(("score", "success", "return"))] = "score"
    rule: BrainConfig | None = None


@dataclass
class RlConfig(Options):
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
        steps: environment steps, all environments together.
        max_minutes: end after this time [min], counted from the start of the command, even if `steps` are not done, but
            for the last validation; nothing: after `steps` only.
        start_from: a checkpoint of a `bhd_mlp`, whose weights become the actor; of a chunk, the first action counts.
        see_ignored: let the actor see what the checkpoint ignores (`policy.ignore`); it begins as if it did not. A
            clone must not see its own speed, because it would repeat it; who learns from what comes of it may.
        see_history: let the actor see `policy.n_obs_steps` observations, `policy.obs_stride` frames apart, where the
            checkpoint sees the last one; it begins as if it saw that only.
        critic_warmup: environment steps in which only the critic learns.
        output_dir: folder of the run; a new one in `outputs/train` if not set.
        resume: continue with the run in `output_dir`.
        seed: of everything that is random.
        threads: threads of torch; its own choice if not set.
    """

    robot: RobotConfig
    task: TaskConfig
    algorithm: Annotated[str, OneOf(("ppo",))] = "ppo"
    env: RlEnvConfig = field(default_factory=RlEnvConfig)
    policy: RlPolicyConfig = field(default_factory=RlPolicyConfig)
    ppo: PpoConfig = field(default_factory=PpoConfig)
    reward: RewardConfig = field(default_factory=RewardConfig)
    validation: ValidationConfig = field(default_factory=ValidationConfig)
    steps: Count = 1_000_000
    max_minutes: Positive | None = None
    start_from: str | None = None
    see_ignored: bool = False
    see_history: bool = False
    critic_warmup: Whole = 0
    output_dir: str | None = None
    resume: bool = False
    seed: LibrarySeed = 0
    threads: Count | None = None

    def __post_init__(self) -> None:
        """Refuse values that cannot be honoured."""
        super().__post_init__()
        self._check_reward()
        _ = self.policy.actor()
        check_task(self.task, self.robot)
        _ = self.environment
        if self.validation.seed == self.seed:
            raise ConfigError(
                f"validation.seed and seed are both {self.seed}; the policy would be evaluated on its training "
                "episodes. Set another --validation.seed."
            )
        if self.start_from is None:
            if self.critic_warmup:
                raise ConfigError(f"critic_warmup is {self.critic_warmup}; it needs --start_from, a checkpoint.")
            if self.see_ignored:
                raise ConfigError("see_ignored is true; it needs --start_from, a checkpoint that ignores something.")
            if self.see_history:
                raise ConfigError("see_history is true; it needs --start_from, a checkpoint that sees one observation.")
        if self.see_history and self.policy.n_obs_steps < 2:
            raise ConfigError("see_history is true; it needs --policy.n_obs_steps of 2 or more.")
        if self.policy.scan.channels and self.policy.scan.transform == "none":
            raise ConfigError("policy.scan.channels needs policy.scan.transform: inverse or log.")
        if self.resume and self.output_dir is None:
            raise ConfigError("resume needs --output_dir, or --config_path with the config.yaml of the run.")

    @property
    def environment(self) -> str:
        """Name of the environment of this robot and task."""
        wanted = self.robot.type, self.task.get_choice_name(type(self.task))
        for name, pair in ENVIRONMENTS.items():
            if pair == wanted:
                return name
        raise ConfigError(
            f"robot.type is {wanted[0]!r} and task.type is {wanted[1]!r}, of which there is no environment. There is: "
            f"{', '.join(map(' with '.join, ENVIRONMENTS.values()))}. Choose one of these, or register another with "
            "bhd_lerobot.register_environment."
        )

    def _check_reward(self) -> None:
        for event in self.reward.events:
            if event not in _EVENTS:
                raise ConfigError(unknown_name("event in reward.events", event, _EVENTS))
        if self.reward.potential == "pose" and "target_qw" not in TASKS.of(self.task).environment_names:
            raise ConfigError("reward.potential is 'pose'; only a task with a target pose of the tool has it (reach).")


def parse_rl(arguments: Sequence[str] | CommandLine) -> RlConfig:
    """Return what a command line asks for; to resume, its `config_path` may be the run's folder."""
    line = read_line(arguments)
    config = parse(RlConfig, line)
    run = line.path if line.path is None or line.path.is_dir() else line.path.parent
    if config.resume and "output_dir" not in line.options and run is not None and (run / CHECKPOINTS_DIR).is_dir():
        config.output_dir = str(run)  # it may have been moved
    return config
