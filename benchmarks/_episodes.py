"""Rules on episodes of known seeds: what the benchmarks of brains share."""

import argparse
from collections.abc import Sequence
from typing import Any

from bhd_lerobot.policies.brain import Brain
from bhd_lerobot.robots.host.simulation import Simulation
from bhd_lerobot.rollout.episode import EpisodeLoop
from bhd_lerobot.rollout.types import Episode, EpisodeSpec
from bhd_lerobot.tasks.task import episode_seed


def add_options(parser: argparse.ArgumentParser, episodes: int) -> None:
    """Add the options that say which episodes are run."""
    parser.add_argument("--episodes", type=int, default=episodes)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--split", choices=("held_out", "train"), default="held_out")


def seeds_of(options: argparse.Namespace) -> list[int]:
    """Return the seeds of the episodes that the options name."""
    return [episode_seed(options.seed, episode, options.split) for episode in range(options.episodes)]


def run(simulation: Simulation, task: Any, brain: Brain, seeds: Sequence[int]) -> list[Episode]:
    """Run a brain on episodes of these seeds; return them in their order."""
    specs = [EpisodeSpec(index, seed) for index, seed in enumerate(seeds)]
    return list(EpisodeLoop(simulation, task, brain).run(specs))
