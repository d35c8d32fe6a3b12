"""Rules on episodes of known seeds: what the benchmarks of brains share."""

import argparse
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from benchmarks._report import Report, parse_options, rate
from bhd_lerobot.evaluation.statistics import wilson
from bhd_lerobot.policies.brain import Brain
from bhd_lerobot.robots.host.simulation import Simulation
from bhd_lerobot.rollout.episode import EpisodeLoop
from bhd_lerobot.rollout.types import Episode, EpisodeSpec
from bhd_lerobot.tasks.task import Outcome, episode_seed

_SPLITS = ("held_out", "train")


def parse_episodes(doc: str | None, episodes: int, **options: Any) -> tuple[argparse.Namespace, list[int]]:
    """Read the command line; return the options, and the seeds of the episodes that they name."""
    split = {"choices": _SPLITS, "default": "held_out"}
    args = parse_options(doc, episodes=episodes, seed=0, split=split, **options)
    return args, [episode_seed(args.seed, episode, args.split) for episode in range(args.episodes)]


def run(simulation: Simulation, task: Any, brain: Brain, seeds: Sequence[int]) -> list[Episode]:
    """Run a brain on episodes of these seeds; return them in their order."""
    specs = [EpisodeSpec(index, seed) for index, seed in enumerate(seeds)]
    return list(EpisodeLoop(simulation, task, brain).run(specs))


def add_success(report: Report, name: str, outcomes: Sequence[Outcome], goal: float | None = None) -> None:
    """Add the row of how many episodes were successes, and how the others ended."""
    found = wilson(sum(outcome.success for outcome in outcomes), len(outcomes))
    causes = Counter(outcome.event.cause for outcome in outcomes if not outcome.success)
    words = "" if goal is None else f"at least {100 * goal:g} %"
    met = None if goal is None else found.value >= goal
    report.add(f"{name}: success in {len(outcomes)}", rate(asdict(found), dict(causes.most_common())), words, met=met)
