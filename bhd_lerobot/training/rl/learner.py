"""PPO on a `bhd_mlp`: actor and critic, the learner, and its loop. Import this only where stable-baselines3 is there.

The actor's modules are those of a `bhd_mlp`, so that exporting it is exact.
"""

import time
from collections.abc import Callable
from dataclasses import asdict
from typing import Any

import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.policies import ActorCriticPolicy
from torch import Tensor, nn

from bhd_lerobot.policies.mlp.modeling_mlp import ACTIVATION_LAYERS, MlpPolicy, chosen_mode
from bhd_lerobot.training.rl.config import RlConfig
from bhd_lerobot.training.rl.environment import RlVecEnv
from bhd_lerobot.training.rl.log import Row
from bhd_lerobot.training.rl.parts import RlParts

_LOGGED = {
    "train/approx_kl": "kl",
    "train/clip_fraction": "clip_fraction",
    "train/explained_variance": "explained_variance",
    "train/value_loss": "value_loss",
    "train/policy_gradient_loss": "policy_loss",
    "train/std": "std",
    "train/learning_rate": "lr",
}
_NEVER = 2**62  # updates between two outputs of stable-baselines3's own log


class ActorHead(nn.Module):
    """From a feature vector, whose beams are not convolved yet, to the last hidden layer of a `bhd_mlp`."""

    def __init__(self, policy: MlpPolicy, size: int) -> None:
        super().__init__()
        self._size = size
        scan, steps = policy.config.scan, policy.config.n_obs_steps
        self.encoder = policy.scan_encoder
        self.hidden = nn.Sequential(*list(policy.net)[:-1])
        self._beams = steps * scan.beams if self.encoder is not None else 0
        self._shape = (steps, scan.beams)

    def forward(self, features: Tensor) -> Tensor:
        """Return the hidden layer, shape (n, width), of vectors, shape (n, size or more)."""
        features = features[:, : self._size]
        if self.encoder is not None:
            numbers, scan = features[:, : -self._beams], features[:, -self._beams :]
            features = torch.cat([numbers, self.encoder(scan.unflatten(1, self._shape))], dim=-1)
        return self.hidden(features)


class ActionHead(nn.Module):
    """From the last hidden layer of a `bhd_mlp` with a chunk of one action to that action, of the likeliest mode."""

    def __init__(self, policy: MlpPolicy) -> None:
        super().__init__()
        self.last = policy.net[-1]
        self._split = policy.split_modes

    def forward(self, hidden: Tensor) -> Tensor:
        """Return actions, shape (n, actions), of hidden layers, shape (n, width)."""
        return chosen_mode(*self._split(self.last(hidden)))[:, 0]


class MlpActorCritic(ActorCriticPolicy):
    """A `bhd_mlp` with a chunk of one action as actor, which shares its parameters with this, and a critic of its own.

    The actor sees the first `actor_size` numbers of a vector. Its linear layers are initialised if it is `fresh`.
    """

    def __init__(self, *args: Any, actor: MlpPolicy, actor_size: int, fresh: bool, **kwargs: Any) -> None:
        # nn.Module wants to be initialised before it gets modules, and SB3 builds the networks while it does so.
        self._ingredients: tuple[MlpPolicy, int, bool] = (actor, actor_size, fresh)
        super().__init__(*args, **{**kwargs, "ortho_init": False})

    def actor_parameters(self) -> list[nn.Parameter]:
        """Return the parameters of the actor, its exploration noise included."""
        return [*self.mlp_extractor.policy_net.parameters(), *self.action_net.parameters(), self.log_std]

    def _build_mlp_extractor(self) -> None:
        super()._build_mlp_extractor()
        actor, actor_size, _ = self._ingredients
        self.mlp_extractor.policy_net = ActorHead(actor, actor_size)  # type: ignore[assignment]
        self.mlp_extractor.latent_dim_pi = int(actor.net[-1].in_features)  # type: ignore[arg-type]

    def _build(self, lr_schedule: Any) -> None:
        super()._build(lr_schedule)
        actor, *_, fresh = self._ingredients
        self.action_net = ActionHead(actor)
        parts: list[tuple[nn.Module, float]] = [(self.mlp_extractor.value_net, 2**0.5), (self.value_net, 1.0)]
        if fresh:
            parts += [(self.mlp_extractor.policy_net, 2**0.5), (self.action_net, 0.01)]
        for module, gain in parts:
            for layer in module.modules():
                if isinstance(layer, nn.Linear):
                    nn.init.orthogonal_(layer.weight, gain=gain)
                    nn.init.zeros_(layer.bias)
        kwargs: dict[str, Any] = {**self.optimizer_kwargs, "lr": lr_schedule(1)}
        self.optimizer = self.optimizer_class(self.parameters(), **kwargs)


class WarmedUpPPO(PPO):
    """PPO of stable-baselines3, whose actor is frozen for the first `critic_warmup` environment steps."""

    policy: MlpActorCritic
    critic_warmup = 0

    def train(self) -> None:
        """Learn from the samples that were gathered."""
        for actor_parameter in self.policy.actor_parameters():
            actor_parameter.requires_grad_(self.num_timesteps > self.critic_warmup)
        super().train()


def make_learner(config: RlConfig, parts: RlParts, env: RlVecEnv) -> WarmedUpPPO:
    """Return PPO on an actor."""
    options = asdict(config.ppo)
    lr, schedule, log_std = (options.pop(name) for name in ("lr", "lr_schedule", "log_std_init"))
    options["batch_size"] = min(options["batch_size"], options["n_steps"] * env.num_envs)
    if log_std is None:
        own = parts.actor.log_std
        log_std = 0.0 if own is None or parts.fresh else float(own.detach().mean())
    learner = WarmedUpPPO(
        MlpActorCritic,
        env,
        learning_rate=lr if schedule == "constant" else lambda remaining: lr * max(0.0, remaining),
        **options,
        seed=config.seed,
        device="cpu",
        policy_kwargs={
            "actor": parts.actor,
            "actor_size": env.stack.size,
            "net_arch": {"pi": [], "vf": list(config.policy.critic_dims)},
            "activation_fn": ACTIVATION_LAYERS[parts.actor.config.activation],
            "fresh": parts.fresh,
            "log_std_init": log_std,
        },
    )
    learner.critic_warmup = config.critic_warmup
    learner.set_logger(Logger(None, []))
    return learner


def learn(learner: WarmedUpPPO, steps: int, updated: Callable[[Any, Row], None], is_over: Callable[[], bool]) -> None:
    """Learn until a number of environment steps is done, or until it is over."""
    watcher = _Watcher(updated, is_over)
    learner.learn(
        max(0, steps - learner.num_timesteps), callback=watcher, log_interval=_NEVER, reset_num_timesteps=False
    )
    watcher.report()


class _Watcher(BaseCallback):
    """Reports after each update, which is before the next samples are gathered."""

    def __init__(self, updated: Callable[[Any, Row], None], is_over: Callable[[], bool]) -> None:
        super().__init__()
        self._updated, self._is_over = updated, is_over
        self._gathered, self._since, self._gathering_s = 0, time.perf_counter(), 0.0
        self._episodes: list[dict[str, Any]] = []

    def _on_rollout_start(self) -> None:
        self.report()
        self._start = time.perf_counter()

    def _on_rollout_end(self) -> None:
        self._gathering_s = time.perf_counter() - self._start

    def _on_step(self) -> bool:
        self._episodes += [info for info in self.locals["infos"] if "episode" in info]
        return not self._is_over()

    def report(self) -> None:
        """Report the last update, if there was one since the last report."""
        frames = self.model.num_timesteps - self._gathered
        values = self.model.logger.name_to_value
        if frames and self._gathering_s:
            took = time.perf_counter() - self._since
            row = _means(self._episodes)
            row |= {name: float(values[key]) for key, name in _LOGGED.items() if key in values}
            row |= {
                "frames_per_s": frames / took,
                "gathering_s": self._gathering_s,
                "update_s": took - self._gathering_s,
            }
            self._episodes = []
            self._updated(self.model, row)
        self._gathered, self._since, self._gathering_s = self.model.num_timesteps, time.perf_counter(), 0.0


def _means(episodes: list[dict[str, Any]]) -> Row:
    """Return the means of episodes that ended, and the share of each failure; nothing if none did."""
    if not episodes:
        return {}
    values = {
        "return": [episode["episode"]["r"] for episode in episodes],
        "success": [episode["is_success"] for episode in episodes],
        "score": [episode["score"] for episode in episodes],
        "length": [episode["episode"]["l"] for episode in episodes],
    }
    row: Row = {"episodes": len(episodes)} | {key: float(np.mean(each)) for key, each in values.items()}
    failures = [episode["event"] for episode in episodes if not episode["is_success"]]
    return row | {cause: failures.count(cause) / len(episodes) for cause in sorted(set(failures))}
