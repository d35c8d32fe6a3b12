"""Episodes that judge a policy on the way: those of a run seed of their own, in the evaluation's own loop."""

from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.policies.brain import BrainConfig
from bhd_lerobot.registry import make_brain, make_simulation, make_task
from bhd_lerobot.rollout.episode import EpisodeLoop
from bhd_lerobot.rollout.types import Episode, EpisodeSpec
from bhd_lerobot.tasks.task import Event, episode_seed
from bhd_lerobot.training.rl.config import RlConfig


class Validation:
    """Runs brains on the validation episodes of a run."""

    def __init__(self, config: RlConfig) -> None:
        own = config.validation
        self._n = min(own.n_envs, own.n_episodes)
        self._simulation = make_simulation(config.robot, self._n, config.env.threads)
        self._task_config, self._fps = config.task, self._simulation.rates.fps
        self._specs = [EpisodeSpec(i, episode_seed(own.seed, i, "train")) for i in range(own.n_episodes)]

    def run(self, brain: BrainConfig, stop: Callable[[], bool]) -> list[Episode]:
        """Return the episodes of a brain; those that a stop cut short are left out."""
        task = make_task(self._task_config, self._n, self._fps, self._simulation.body)
        return list(EpisodeLoop(self._simulation, task, make_brain(brain)).run(self._specs, stop))

    def close(self) -> None:
        """Free the simulations."""
        self._simulation.close()


def level(episodes: Sequence[Episode]) -> dict[str, Any]:
    """Return how good a brain was, as part of a row of `metrics.jsonl`; nothing without episodes.

    Mean score, share of successes, mean sum of the task's rewards, and the share of each cause of failure.
    """
    if not episodes:
        return {}
    n = len(episodes)
    causes = Counter(episode.outcome.event.cause for episode in episodes if episode.outcome.event != Event.SUCCESS)
    return {
        "val_score": float(np.mean([episode.outcome.score for episode in episodes])),
        "val_success": float(np.mean([episode.outcome.success for episode in episodes])),
        "val_return": float(np.mean([np.sum(episode.columns[keys.REWARD]) for episode in episodes])),
        **{f"val_{cause}": count / n for cause, count in sorted(causes.items())},
    }
