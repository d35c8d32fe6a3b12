"""Episodes that judge a policy on the way: those of a run seed of their own, in the evaluation's own loop."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.policies.learned.brain import LearnedBrainConfig
from bhd_lerobot.registry import make_brain, make_simulation, make_task
from bhd_lerobot.rollout.episode import EpisodeLoop
from bhd_lerobot.rollout.types import Episode, EpisodeSpec
from bhd_lerobot.tasks.task import Event, episode_seed
from bhd_lerobot.training.rl.config import RlConfig


@dataclass(frozen=True)
class Level:
    """How good a brain was.

    Attributes:
        episodes: number of episodes; those that a stop cut short do not count.
        score: mean score.
        success: share of successes.
        reward: mean sum of the task's rewards, under the name `return`.
        failures: share of each cause of failure.
    """

    episodes: int
    score: float
    success: float
    reward: float
    failures: dict[str, float]

    def row(self, prefix: str = "val") -> dict[str, Any]:
        """Return it as part of a row of `metrics.jsonl`."""
        return {
            f"{prefix}_score": self.score,
            f"{prefix}_success": self.success,
            f"{prefix}_return": self.reward,
            **{f"{prefix}_{cause}": share for cause, share in self.failures.items()},
        }


class Validation:
    """Runs brains on the validation episodes."""

    def __init__(self, config: RlConfig) -> None:
        own = config.validation
        self._n = min(own.n_envs, own.n_episodes)
        self._simulation = make_simulation(config.robot, self._n, config.env.threads)
        self._task_config, self._fps = config.task, self._simulation.rates.fps
        every = own.n_episodes + own.confirm
        specs = [EpisodeSpec(i, episode_seed(own.seed, i, "train")) for i in range(every)]
        self._specs, self._further = specs[: own.n_episodes], specs[own.n_episodes :]

    def run(self, brain: Any, stop: Callable[[], bool] = lambda: False, *, further: bool = False) -> list[Episode]:
        """Return the episodes of a brain, given by its configuration; with `further`, those that confirm."""
        task = make_task(self._task_config, self._n, self._fps, self._simulation.body)
        specs = self._further if further else self._specs
        return list(EpisodeLoop(self._simulation, task, make_brain(brain)).run(specs, stop))

    def checkpoint(
        self, folder: Any, stop: Callable[[], bool] = lambda: False, *, further: bool = False
    ) -> Level | None:
        """Return how good the policy in a folder is; None if a stop came first."""
        return level(self.run(LearnedBrainConfig(path=str(folder)), stop, further=further))

    def close(self) -> None:
        """Free the simulations."""
        self._simulation.close()


def level(episodes: Sequence[Episode]) -> Level | None:
    """Return how good a brain was; None without episodes."""
    if not episodes:
        return None
    n = len(episodes)
    causes = Counter(episode.outcome.event.cause for episode in episodes if episode.outcome.event != Event.SUCCESS)
    return Level(
        episodes=n,
        score=float(np.mean([episode.outcome.score for episode in episodes])),
        success=float(np.mean([episode.outcome.success for episode in episodes])),
        reward=float(np.mean([np.sum(episode.columns[keys.REWARD]) for episode in episodes])),
        failures={cause: count / n for cause, count in sorted(causes.items())},
    )
