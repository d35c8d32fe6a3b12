"""The two rules beside each other on the same random arenas: failures, score, time: `python -m benchmarks.brains`.

The goal: gap_follower fails no more often than avoidance, at most a third as often where that one fails in more than
5 %, and has at least 1.5 times its mean score. Exits with 3 if it is missed.
"""

import argparse
import sys
from collections import Counter
from dataclasses import dataclass

import numpy as np

from benchmarks._episodes import add_options, run, seeds_of
from benchmarks._turns import seconds, verdict
from bhd_lerobot.evaluation.results import SCORE_RANGE
from bhd_lerobot.evaluation.statistics import mean, ratio_of_means, wilson
from bhd_lerobot.policies.brain import Brain, Observation
from bhd_lerobot.policies.navigation.avoidance import AvoidanceBrain
from bhd_lerobot.policies.navigation.gap_follower import GapFollowerBrain
from bhd_lerobot.robots.base_simulation import BaseSimulation
from bhd_lerobot.robots.config_turtlebot3 import TurtleBot3Config
from bhd_lerobot.tasks.avoid import AvoidConfig, AvoidTask
from bhd_lerobot.tasks.task import Event, Outcome

GOAL_RATIO = 1.5
SIDE_BY_SIDE = 50
CALLS = 200


@dataclass
class Result:
    """What a brain achieved.

    Attributes:
        outcomes: of the episodes, in order.
        act_ms: median time of a call for 1 and for 64 robots [ms].
    """

    outcomes: list[Outcome]
    act_ms: dict[int, float]

    @property
    def scores(self) -> np.ndarray:
        """The score of each episode."""
        return np.array([outcome.score for outcome in self.outcomes])

    @property
    def failures(self) -> int:
        """Number of episodes without success."""
        return sum(not outcome.success for outcome in self.outcomes)


def main() -> int:
    """Run both brains, print the table, return 0 if the goal is met."""
    parser = argparse.ArgumentParser(description=__doc__)
    add_options(parser, 200)
    parser.add_argument("--episode_s", type=float, default=60.0, help="simulated duration of an episode [s]")
    args = parser.parse_args()
    seeds = seeds_of(args)
    brains: tuple[Brain, ...] = (AvoidanceBrain(), GapFollowerBrain())
    old, new = results = [measure(brain, seeds, args.episode_s) for brain in brains]
    print(f"{args.episodes} {args.split} random arenas, seed {args.seed}, {args.episode_s:g} s each\n")
    print(f"{'':14}{'failures':>9}{'by cause':>24}{'share, 95 %':>22}{'score, 95 %':>28}{'act, n=1':>11}{'n=64':>10}")
    for brain, result in zip(brains, results, strict=True):
        print(row(brain.name, result))
    ratio = ratio_of_means(new.scores, old.scores, within=SCORE_RANGE)
    interval = f"95 % {ratio.low:.3f} to {ratio.high:.3f} (Fieller, paired)"
    print(f"\nscore ratio {ratio.value:.3f}, {interval}; goal: {GOAL_RATIO}")
    allowed = old.failures // 3 if old.failures > 0.05 * args.episodes else old.failures
    print(f"failures {new.failures}; allowed: {allowed}")
    return verdict(met=ratio.value >= GOAL_RATIO and new.failures <= allowed)


def measure(brain: Brain, seeds: list[int], episode_s: float) -> Result:
    """Run a brain on the arenas of these seeds, for so many seconds each."""
    config = TurtleBot3Config()
    n = min(SIDE_BY_SIDE, len(seeds))
    simulation = BaseSimulation(config, n)
    task = AvoidTask(AvoidConfig(duration_s=episode_s), n, config.fps)
    outcomes = [one.outcome for one in run(simulation, task, brain, seeds)]
    state = simulation.observe().state
    return Result(outcomes, {n: act_ms(brain, simulation.observation_names, state, n) for n in (1, 64)})


def act_ms(brain: Brain, names: tuple[str, ...], state: np.ndarray, n: int) -> float:
    """Return the median time of a call for n robots [ms]."""
    brain.reset(np.arange(n), [0] * n, n)
    observation = Observation(names, np.resize(state, (n, state.shape[1])))
    return float(np.median([seconds(lambda: brain.act(observation)) for _ in range(CALLS)])) * 1e3


def row(name: str, result: Result) -> str:
    """Return a brain's line of the table."""
    count = len(result.outcomes)
    causes = Counter(outcome.event.cause for outcome in result.outcomes if outcome.event != Event.SUCCESS)
    by_cause = ", ".join(f"{cause} {number}" for cause, number in sorted(causes.items())) or "none"
    failed, scored = wilson(result.failures, count), mean(result.scores)
    share = f"{failed.value:.1%} ({failed.low:.1%} to {failed.high:.1%})"
    score = f"{scored.value:.4f} ({scored.low:.4f} to {scored.high:.4f})"
    times = f"{result.act_ms[1]:>8.3f} ms{result.act_ms[64]:>7.2f} ms"
    return f"{name:14}{result.failures:>9}{by_cause:>24}{share:>22}{score:>28}{times}"


if __name__ == "__main__":
    sys.exit(main())
