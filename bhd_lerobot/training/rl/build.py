"""The learner, and its loop. Import this only where stable-baselines3 is known to be there."""

import time
from collections.abc import Callable
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger

from bhd_lerobot.training.rl.actor import MlpActorCritic
from bhd_lerobot.training.rl.adapter import RlVecEnv
from bhd_lerobot.training.rl.config import RlConfig
from bhd_lerobot.training.rl.log import Row
from bhd_lerobot.training.rl.parts import RlParts
from bhd_lerobot.training.rl.ppo import AnchoredPPO

_LOGGED = {
    "train/approx_kl": "kl",
    "train/clip_fraction": "clip_fraction",
    "train/explained_variance": "explained_variance",
    "train/value_loss": "value_loss",
    "train/policy_gradient_loss": "policy_loss",
    "train/std": "std",
    "train/learning_rate": "lr",
    "train/anchor_kl": "anchor_kl",
}


_NEVER = 2**62  # updates between two outputs of stable-baselines3's own log


def make_learner(config: RlConfig, parts: RlParts, env: RlVecEnv, done: Callable[[int], float]) -> AnchoredPPO:
    """Return PPO on an actor.

    Args:
        config: of the run.
        parts: the actor and what belongs to it.
        env: the environments.
        done: how much of the run is done after a step, from 0 to 1.
    """
    ppo = config.ppo
    learners: list[AnchoredPPO] = []

    def rate(remaining: float) -> float:
        # Stable-baselines3 counts steps; here the time may be up first. It asks before there is a learner, too.
        left = 1 - done(learners[0].num_timesteps) if learners else 1.0
        return ppo.lr if ppo.lr_schedule == "constant" else ppo.lr * left

    log_std = ppo.log_std_init
    if log_std is None:
        own = parts.actor.log_std
        log_std = 0.0 if own is None or parts.fresh else float(own.detach().mean())
    learner = AnchoredPPO(
        MlpActorCritic,
        env,
        learning_rate=rate,
        n_steps=ppo.n_steps,
        batch_size=min(ppo.batch_size, ppo.n_steps * env.num_envs),
        n_epochs=ppo.n_epochs,
        gamma=ppo.gamma,
        gae_lambda=ppo.gae_lambda,
        clip_range=ppo.clip_range,
        ent_coef=ppo.ent_coef,
        vf_coef=ppo.vf_coef,
        max_grad_norm=ppo.max_grad_norm,
        target_kl=ppo.target_kl,
        seed=config.seed,
        device="cpu",
        policy_kwargs={
            "actor": parts.actor,
            "critic_dims": list(config.policy.critic_dims),
            "fresh": parts.fresh,
            "log_std_init": log_std,
        },
        critic_warmup=config.critic_warmup,
        anchor_coef=config.anchor.coef,
        anchor_batch=config.anchor.batch_size,
        anchor_decay=config.anchor.decay,
        done=done,
    )
    learners.append(learner)
    learner.set_logger(Logger(None, []))
    return learner


def learn(learner: AnchoredPPO, steps: int, updated: Callable[[Any, Row], None], is_over: Callable[[], bool]) -> None:
    """Learn until a number of environment steps is done, or until it is over.

    Args:
        learner: what learns.
        steps: environment steps in all.
        updated: is told of the learner and what it measured, after each update.
        is_over: asked after each frame.
    """
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

    def _on_rollout_start(self) -> None:
        self.report()
        self._start = time.perf_counter()

    def _on_rollout_end(self) -> None:
        self._gathering_s = time.perf_counter() - self._start

    def _on_step(self) -> bool:
        return not self._is_over()

    def report(self) -> None:
        """Tell of the last update, if there was one since the last report."""
        frames = self.model.num_timesteps - self._gathered
        values = self.model.logger.name_to_value
        if frames and self._gathering_s:
            took = time.perf_counter() - self._since
            row: Row = {name: float(values[key]) for key, name in _LOGGED.items() if key in values}
            row |= {
                "frames_per_s": frames / took,
                "gathering_s": self._gathering_s,
                "update_s": took - self._gathering_s,
            }
            self._updated(self.model, row)
        self._gathered, self._since, self._gathering_s = self.model.num_timesteps, time.perf_counter(), 0.0
