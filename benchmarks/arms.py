"""The scripted brains of the UR5 on held-out seeds: `python -m benchmarks.arms`.

Success of reach, of pick without and with domain randomisation, and of the language brain, with Wilson intervals and
causes of failure. Exits with 3 if a goal is missed.
"""

import argparse
import json
import sys
import time
from collections import Counter
from dataclasses import dataclass

from benchmarks._episodes import add_options, run, seeds_of
from benchmarks._turns import verdict
from bhd_lerobot.evaluation.statistics import wilson
from bhd_lerobot.policies.brain import Brain
from bhd_lerobot.policies.language.language_brain import LanguageBrain
from bhd_lerobot.policies.manipulation.pick import PickBrain
from bhd_lerobot.policies.manipulation.reach import ReachBrain
from bhd_lerobot.robots.config_ur5 import UR5Config
from bhd_lerobot.robots.ur5_simulation import UR5Simulation
from bhd_lerobot.tasks.pick import PickConfig, PickTask
from bhd_lerobot.tasks.reach import ReachConfig, ReachTask
from bhd_lerobot.tasks.task import Task
from bhd_lerobot.tasks.variation import RandomisationConfig

SIDE_BY_SIDE = 32
_FPS = UR5Config().fps


@dataclass
class Case:
    """One row of the table.

    Attributes:
        name: its name.
        task: what is to be achieved.
        brain: what drives the arms.
        goal: smallest share of successes.
    """

    name: str
    task: Task
    brain: Brain
    goal: float


def cases(n: int) -> list[Case]:
    """Return what is measured, with n simulations side by side."""
    wild = RandomisationConfig(enabled=True)
    pick, wild_pick = PickTask(PickConfig(), n, _FPS), PickTask(PickConfig(randomisation=wild), n, _FPS)
    spoken = PickTask(PickConfig(language="any"), n, _FPS)
    return [
        Case("reach", ReachTask(ReachConfig(), n, _FPS), ReachBrain(), 0.998),
        Case("pick", pick, PickBrain(), 0.98),
        Case("pick, randomised", wild_pick, PickBrain(), 0.95),
        Case("pick, by language", spoken, LanguageBrain(), 0.98),
    ]


def main() -> int:
    """Run the cases, print the table, return 0 if every goal is met."""
    parser = argparse.ArgumentParser(description=__doc__)
    add_options(parser, 1000)
    parser.add_argument("--case", help="only the cases whose name holds this")
    args = parser.parse_args()
    seeds = seeds_of(args)
    print(f"{args.episodes} {args.split} episodes, seed {args.seed}\n")
    print(f"{'':20}{'success':>9}{'95 %':>20}{'goal':>8}{'mean time':>11}{'real time':>11}  failures")
    missed = False
    n = min(SIDE_BY_SIDE, len(seeds))
    for case in cases(n):
        if args.case and args.case not in case.name:
            continue
        started = time.perf_counter()
        episodes = run(UR5Simulation(UR5Config(), n), case.task, case.brain, seeds)
        took = time.perf_counter() - started
        good = sum(episode.outcome.success for episode in episodes)
        rate = wilson(good, len(episodes))
        causes = Counter(episode.outcome.event.cause for episode in episodes if not episode.outcome.success)
        seconds = sum(episode.frames for episode in episodes) / _FPS
        by_cause = ", ".join(f"{cause} {count}" for cause, count in causes.most_common()) or "none"
        print(
            f"{case.name:20}{rate.value:>9.2%}{f'{rate.low:.2%} to {rate.high:.2%}':>20}{case.goal:>8.1%}"
            f"{seconds / len(episodes):>9.2f} s{seconds / took:>9.0f} x  {by_cause}"
        )
        for episode in episodes:
            if not episode.outcome.success:
                why = episode.plan.get("problem") or [end.message for _, end in episode.results if not end.success]
                print(f"    episode {episode.spec.index}: {episode.outcome.event.cause}; {json.dumps(why)}")
        missed |= good / len(episodes) < case.goal
    return verdict(met=not missed)


if __name__ == "__main__":
    sys.exit(main())
