"""The navigator on held-out scenes: success, collisions, path length, time: `python -m benchmarks.navigate`.

The goal: at least 99 % success, no collision, and a mean SPL (success weighted by path length) above 0.85. Exits with 3
if it is missed.
"""

import argparse
import sys
import time
from collections import Counter
from dataclasses import asdict
from pathlib import Path

import numpy as np

from benchmarks._episodes import add_options, run, seeds_of
from benchmarks._turns import verdict, write
from bhd_lerobot.evaluation.statistics import mean, wilson
from bhd_lerobot.policies.brain import Observation
from bhd_lerobot.policies.navigation.navigator import NavigatorBrain
from bhd_lerobot.robots.base_simulation import BaseSimulation
from bhd_lerobot.robots.config_turtlebot3 import TurtleBot3Config
from bhd_lerobot.tasks.navigate import NavigateConfig, NavigateTask
from bhd_lerobot.tasks.task import Event, Outcome

GOAL_SUCCESS = 0.99
GOAL_SPL = 0.85
SIDE_BY_SIDE = 50


class TimedBrain(NavigatorBrain):
    """The navigator, and how long its calls take [s]."""

    def __init__(self) -> None:
        super().__init__()
        self.times: list[float] = []

    def act(self, observation: Observation) -> np.ndarray:
        """Return the twist, and note how long it took."""
        started = time.perf_counter()
        action = super().act(observation)
        self.times.append(time.perf_counter() - started)
        return action


def main() -> int:
    """Run the brain, print what came of it, return 0 if the goal is met."""
    parser = argparse.ArgumentParser(description=__doc__)
    add_options(parser, 500)
    parser.add_argument("--arena", default="random")
    parser.add_argument("--json", type=Path, help="write the numbers to this file as well")
    args = parser.parse_args()
    task = NavigateConfig(arena=args.arena, random_start=args.arena != "random")
    seeds = seeds_of(args)
    print(f"{args.episodes} {args.split} scenes, arena {args.arena}, seed {args.seed}\n")
    outcomes, times = drive(task, seeds, min(SIDE_BY_SIDE, len(seeds)))
    _, alone = drive(task, seeds[:5], 1)
    causes = Counter(outcome.event.cause for outcome in outcomes)
    good = [outcome for outcome in outcomes if outcome.success]
    rate = wilson(len(good), len(outcomes))
    spl = np.array([outcome.score for outcome in outcomes])
    duration = np.array([outcome.details["time_s"] for outcome in good])
    print(f"success     {rate.value:.1%} ({rate.low:.1%} to {rate.high:.1%}), goal {GOAL_SUCCESS:.0%}")
    print(f"ends        {', '.join(f'{cause} {count}' for cause, count in causes.most_common())}")
    print(f"SPL         mean {spl.mean():.3f}, 5 % below {np.percentile(spl, 5):.3f}, goal {GOAL_SPL}")
    if len(duration):
        print(f"time        median {np.median(duration):.1f} s, longest {duration.max():.1f} s")
    for n, one in ((1, alone), (min(SIDE_BY_SIDE, len(seeds)), times)):
        print(f"act, n={n:<4} mean {one.mean() * 1e3:.2f} ms, median {np.median(one) * 1e3:.2f} ms")
    failed = [index for index, outcome in enumerate(outcomes) if not outcome.success]
    if failed:
        print("failed      " + ", ".join(f"{index} ({outcomes[index].event.cause})" for index in failed))
    collisions = causes[Event.COLLISION.cause]
    met = rate.value >= GOAL_SUCCESS and not collisions and spl.mean() > GOAL_SPL
    write(
        args.json,
        {
            "episodes": len(outcomes),
            "split": args.split,
            "arena": args.arena,
            "seed": args.seed,
            "success": {**asdict(rate), "goal": GOAL_SUCCESS, "met": rate.value >= GOAL_SUCCESS},
            "ends": dict(causes),
            "collisions": {"value": collisions, "goal": 0, "met": not collisions},
            "spl": {**asdict(mean(spl)), "goal": GOAL_SPL, "met": bool(spl.mean() > GOAL_SPL)},
            "median_time_s": float(np.median(duration)) if len(duration) else None,
            "act_s": {"1": float(np.median(alone)), str(min(SIDE_BY_SIDE, len(seeds))): float(np.median(times))},
            "met": bool(met),
        },
    )
    return verdict(met=bool(met))


def drive(config: NavigateConfig, seeds: list[int], n: int) -> tuple[list[Outcome], np.ndarray]:
    """Run the brain in the scenes of these seeds, n side by side; return the outcomes, and the times of its calls."""
    robot, brain = TurtleBot3Config(collision_monitor=True), TimedBrain()
    episodes = run(BaseSimulation(robot, n), NavigateTask(config, n, robot.fps), brain, seeds)
    return [episode.outcome for episode in episodes], np.array(brain.times)


if __name__ == "__main__":
    sys.exit(main())
