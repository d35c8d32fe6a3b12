"""Actor and critic for stable-baselines3. The actor's modules are those of a `bhd_mlp`, so that exporting it is exact.

Import this only where stable-baselines3 is known to be there.
"""

from typing import Any

import torch
from gymnasium import spaces
from stable_baselines3.common.policies import ActorCriticPolicy
from torch import Tensor, nn

from bhd_lerobot.policies.mlp.modeling_mlp import MlpPolicy

ACTIVATIONS: dict[str, type[nn.Module]] = {
    "relu": nn.ReLU,
    "tanh": nn.Tanh,
    "gelu": nn.GELU,
    "silu": nn.SiLU,
    "elu": nn.ELU,
}


class ActorHead(nn.Module):
    """From a feature vector, whose beams are not convolved yet, to the last hidden layer of a `bhd_mlp`.

    Args:
        policy: the `bhd_mlp`; its modules are shared, not copied.
    """

    def __init__(self, policy: MlpPolicy) -> None:
        super().__init__()
        scan, steps = policy.config.scan, policy.config.n_obs_steps
        self.encoder = policy.scan_encoder
        self.hidden = nn.Sequential(*list(policy.net)[:-1])
        self._beams = steps * scan.beams if self.encoder is not None else 0
        self._shape = (steps, scan.beams)

    def forward(self, features: Tensor) -> Tensor:
        """Return the hidden layer, shape (n, width), of vectors, shape (n, size)."""
        if self.encoder is not None:
            numbers, scan = features[:, : -self._beams], features[:, -self._beams :]
            features = torch.cat([numbers, self.encoder(scan.unflatten(1, self._shape))], dim=-1)
        return self.hidden(features)


class Networks(nn.Module):
    """The hidden layers of actor and critic, in the form that `ActorCriticPolicy` asks for.

    Args:
        policy: the actor.
        size: width of a feature vector.
        critic_dims: widths of the critic's hidden layers.
    """

    def __init__(self, policy: MlpPolicy, size: int, critic_dims: list[int]) -> None:
        super().__init__()
        self.policy_net = ActorHead(policy)
        self.latent_dim_pi = int(policy.net[-1].in_features)  # type: ignore[arg-type]
        layers: list[nn.Module] = []
        width = size
        for dim in critic_dims:
            layers += [nn.Linear(width, dim), ACTIVATIONS[policy.config.activation]()]
            width = dim
        self.value_net = nn.Sequential(*layers)
        self.latent_dim_vf = width

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Return the last hidden layers of both."""
        return self.forward_actor(features), self.forward_critic(features)

    def forward_actor(self, features: Tensor) -> Tensor:
        """Return the actor's last hidden layer."""
        return self.policy_net(features)

    def forward_critic(self, features: Tensor) -> Tensor:
        """Return the critic's last hidden layer."""
        return self.value_net(features)


class MlpActorCritic(ActorCriticPolicy):
    """A `bhd_mlp` as actor, and a critic of its own.

    Attributes:
        actor: the `bhd_mlp`, which shares its parameters with this.

    Args:
        observation_space: vectors of a `FeatureStack`.
        action_space: normalised actions.
        lr_schedule: of the learning rate.
        actor: the `bhd_mlp`, with a chunk of one action.
        critic_dims: widths of the critic's hidden layers.
        fresh: initialise the actor's linear layers; otherwise they stay as they are.
        kwargs: what stable-baselines3 passes besides.
    """

    def __init__(
        self,
        observation_space: spaces.Box,
        action_space: spaces.Box,
        lr_schedule: Any,
        *,
        actor: MlpPolicy,
        critic_dims: list[int],
        fresh: bool,
        **kwargs: Any,
    ) -> None:
        # nn.Module wants to be initialised before it gets modules, and SB3 builds the networks while it does so.
        self._ingredients: tuple[MlpPolicy, list[int], bool] = (actor, critic_dims, fresh)
        super().__init__(observation_space, action_space, lr_schedule, ortho_init=False, **kwargs)

    @property
    def actor(self) -> MlpPolicy:
        """The `bhd_mlp`, which shares its parameters with this."""
        return self._ingredients[0]

    def actor_parameters(self) -> list[nn.Parameter]:
        """Return the parameters of the actor, its exploration noise included."""
        return [*self.mlp_extractor.policy_net.parameters(), *self.action_net.parameters(), self.log_std]

    def _build_mlp_extractor(self) -> None:
        actor, critic_dims, _ = self._ingredients
        self.mlp_extractor = Networks(actor, self.features_dim, critic_dims)  # type: ignore[assignment]

    def _build(self, lr_schedule: Any) -> None:
        super()._build(lr_schedule)
        actor, _, fresh = self._ingredients
        self.action_net = actor.net[-1]
        parts: list[tuple[nn.Module, float]] = [(self.mlp_extractor.value_net, 2**0.5), (self.value_net, 1.0)]
        if fresh:
            parts += [(self.mlp_extractor.policy_net, 2**0.5), (self.action_net, 0.01)]
        for module, gain in parts:
            for one in module.modules():
                if isinstance(one, nn.Linear):
                    nn.init.orthogonal_(one.weight, gain=gain)
                    nn.init.zeros_(one.bias)
        kwargs: dict[str, Any] = {**self.optimizer_kwargs, "lr": lr_schedule(1)}
        self.optimizer = self.optimizer_class(self.parameters(), **kwargs)
