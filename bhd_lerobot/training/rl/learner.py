"""PPO on a `bhd_mlp`: actor, critic and learner. Import this only where stable-baselines3 is there.

The actor's modules are those of a `bhd_mlp`, so that exporting it is exact.
"""

from dataclasses import asdict
from typing import Any

import torch
from stable_baselines3 import PPO
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.policies import ActorCriticPolicy
from torch import Tensor, nn

from bhd_lerobot.policies.mlp.modeling_mlp import ACTIVATION_LAYERS, MlpPolicy, chosen_mode
from bhd_lerobot.training.rl.config import RlConfig
from bhd_lerobot.training.rl.environment import RlVecEnv
from bhd_lerobot.training.rl.parts import RlParts


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


def make_learner(config: RlConfig, parts: RlParts, env: RlVecEnv) -> PPO:
    """Return PPO on an actor."""
    options = asdict(config.ppo)
    lr, schedule, log_std = (options.pop(name) for name in ("lr", "lr_schedule", "log_std_init"))
    options["batch_size"] = min(options["batch_size"], options["n_steps"] * env.num_envs)
    if log_std is None:
        own = parts.actor.log_std
        log_std = 0.0 if own is None or parts.fresh else float(own.detach().mean())
    learner = PPO(
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
    learner.set_logger(Logger(None, []))
    return learner
