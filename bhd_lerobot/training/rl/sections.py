"""The parts of a configuration of reinforcement learning."""

import copy
from dataclasses import dataclass, field

from bhd_lerobot.policies.brain import BrainConfig
from bhd_lerobot.policies.mlp.configuration_mlp import MlpConfig, ScanConfig
from bhd_lerobot.tasks.task import Event

SCHEDULES = ("linear", "constant")
POTENTIALS = ("none", "pose")
SELECTIONS = ("score", "success", "return")
EVENTS = tuple(event.cause for event in Event if event != Event.NOTHING)


@dataclass
class RlEnvConfig:
    """The environments that are learned in.

    Attributes:
        n_envs: how many run side by side.
        threads: threads that step the physics; all processors if nothing.
    """

    n_envs: int = 64
    threads: int | None = None


@dataclass
class RlPolicyConfig:
    """The actor, a `bhd_mlp`; with `start_from` the checkpoint decides, and all of this but `critic_dims` is ignored.

    Attributes:
        n_obs_steps: observations that it looks at.
        obs_stride: frames from each of them to the next.
        hidden_dims: widths of the hidden layers.
        activation: one of bhd_mlp's.
        layer_norm: normalise each hidden layer before its activation.
        feature_clip: normalised inputs beyond ± this count as this; nothing turns it off.
        scan: how a range finder's beams become inputs.
        critic_dims: widths of the critic's hidden layers.
    """

    n_obs_steps: int = 1
    obs_stride: int = 1
    hidden_dims: list[int] = field(default_factory=lambda: [256, 256])
    activation: str = "tanh"
    layer_norm: bool = False
    feature_clip: float | None = 10.0
    scan: ScanConfig = field(default_factory=ScanConfig)
    critic_dims: list[int] = field(default_factory=lambda: [256, 256])

    def actor(self) -> MlpConfig:
        """Return the configuration of an actor that begins from nothing.

        Raises:
            ConfigError: a value that a `bhd_mlp` cannot have.
        """
        return MlpConfig(
            n_obs_steps=self.n_obs_steps,
            obs_stride=self.obs_stride,
            chunk_size=1,
            n_action_steps=1,
            hidden_dims=list(self.hidden_dims),
            activation=self.activation,
            layer_norm=self.layer_norm,
            feature_clip=self.feature_clip,
            gaussian=True,
            scan=copy.deepcopy(self.scan),
            device="cpu",
            push_to_hub=False,
        )


@dataclass
class PpoConfig:
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
        lr_schedule: ``"linear"``: to 0 over the training; ``"constant"``.
        target_kl: an update ends when the policy has changed by 1.5 times this; nothing turns it off.
        log_std_init: logarithm of the exploration noise, in normalised actions; the checkpoint's own, or 0, if nothing.
    """

    n_steps: int = 64
    batch_size: int = 1024
    n_epochs: int = 5
    gamma: float = 0.99
    gae_lambda: float = 0.95
    clip_range: float = 0.2
    ent_coef: float = 0.0
    vf_coef: float = 0.5
    max_grad_norm: float = 0.5
    lr: float = 3e-4
    lr_schedule: str = "linear"
    target_kl: float | None = None
    log_std_init: float | None = None


@dataclass
class RewardConfig:
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

    scale: float = 1.0
    events: dict[str, float] = field(default_factory=dict)
    frame: float = 0.0
    potential: str = "none"
    per_m: float = 2.0
    per_rad: float = 0.5


@dataclass
class ValidationConfig:
    """Episodes that judge the policy on the way. They are neither those of the training nor any held-out ones.

    Attributes:
        freq: environment steps between two validations.
        n_episodes: how many episodes.
        n_envs: how many run side by side.
        seed: run seed of these episodes, of the split `train`; another than the training's.
        select: what makes a checkpoint the best: ``"score"``, ``"success"`` or ``"return"``.
        rule: a brain whose level is drawn beside the curve; also what normalisation is estimated from. None if nothing.
    """

    freq: int = 200_000
    n_episodes: int = 64
    n_envs: int = 64
    seed: int = 777_001
    select: str = "score"
    rule: BrainConfig | None = None


@dataclass
class AnchorConfig:
    """What keeps the actor near the checkpoint that it started from.

    Attributes:
        coef: weight of the KL divergence from the checkpoint's policy; 0 turns it off.
        batch_size: samples of a gradient step.
        decay: whether the weight falls to 0 over the training.
    """

    coef: float = 0.0
    batch_size: int = 4096
    decay: bool = True
