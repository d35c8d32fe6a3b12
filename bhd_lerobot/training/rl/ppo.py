"""PPO with what a start from a checkpoint needs: a warm-up of the critic, and an anchor. Needs stable-baselines3."""

import copy
from collections.abc import Callable
from typing import Any

import torch
from stable_baselines3 import PPO
from torch import Tensor, nn

from bhd_lerobot.training.rl.actor import MlpActorCritic


class AnchoredPPO(PPO):
    """Stable-baselines3's PPO; its actor can be frozen at first, and be kept near the one that it started as.

    The anchor is a pass of gradient steps over the samples of an update, after PPO's own: it lowers the divergence
    KL(first, policy) times the weight.

    Args:
        args: see `stable_baselines3.PPO`.
        critic_warmup: environment steps in which the actor is frozen.
        anchor_coef: weight of the anchor; 0 turns it off.
        anchor_batch: samples of its gradient steps.
        anchor_decay: whether its weight falls to 0 over the training.
        done: how much of the run is done after an environment step, from 0 to 1.
        kwargs: see `stable_baselines3.PPO`.
    """

    policy: MlpActorCritic

    def __init__(
        self,
        *args: Any,
        critic_warmup: int = 0,
        anchor_coef: float = 0.0,
        anchor_batch: int = 4096,
        anchor_decay: bool = True,
        done: Callable[[int], float] = lambda step: 0.0,
        **kwargs: Any,
    ) -> None:
        super().__init__(*args, **kwargs)
        self._warmup = critic_warmup
        self._coef, self._batch, self._decay = anchor_coef, anchor_batch, anchor_decay
        self._done = done
        self._first: tuple[nn.Module, nn.Module, Tensor] | None = None
        if anchor_coef:
            self._first = copy.deepcopy(
                (self.policy.mlp_extractor.policy_net, self.policy.action_net, self.policy.log_std.detach())
            )

    def train(self) -> None:
        """Learn from the samples that were gathered."""
        frozen = self.num_timesteps <= self._warmup
        for one in self.policy.actor_parameters():
            one.requires_grad_(not frozen)
        super().train()
        if self._first is not None and not frozen:
            self._pull(self._coef * (1 - self._done(self.num_timesteps) if self._decay else 1.0))

    def _pull(self, coef: float) -> None:
        assert self._first is not None
        hidden, output, log_std = self._first
        total, count = 0.0, 0
        for samples in self.rollout_buffer.get(self._batch):
            features: Any = samples.observations
            with torch.no_grad():
                target = torch.distributions.Normal(output(hidden(features)), log_std.exp())
            mean = self.policy.action_net(self.policy.mlp_extractor.forward_actor(features))
            distribution = torch.distributions.Normal(mean, self.policy.log_std.exp())
            divergence = torch.distributions.kl_divergence(target, distribution).sum(1).mean()
            self.policy.optimizer.zero_grad()
            (coef * divergence).backward()
            nn.utils.clip_grad_norm_(self.policy.parameters(), self.max_grad_norm)
            self.policy.optimizer.step()
            total, count = total + float(divergence.detach()), count + 1
        self.logger.record("train/anchor_kl", total / max(count, 1))
