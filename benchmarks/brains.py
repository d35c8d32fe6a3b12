"""The two rules beside each other on the same random arenas: failures, score, time: `python -m benchmarks.brains`.

The goal: gap_follower fails no more often than avoidance, at most a third as often where that one fails in more than
5 %, and has at least 1.5 times its mean score. Exits with 3 if it is missed.
"""

import sys
from dataclasses import asdict

import numpy as np

from benchmarks._episodes import add_success, parse_episodes, run
from benchmarks._report import Report, mean
from benchmarks._turns import seconds
from bhd_lerobot.evaluation import statistics
from bhd_lerobot.evaluation.results import SCORE_RANGE
from bhd_lerobot.policies.brain import Brain, Observation
from bhd_lerobot.policies.navigation.avoidance import AvoidanceBrain
from bhd_lerobot.policies.navigation.gap_follower import GapFollowerBrain
from bhd_lerobot.robots.config_turtlebot3 import TurtleBot3Config
from bhd_lerobot.robots.host.simulation import Simulation
from bhd_lerobot.tasks.avoid import AvoidConfig, AvoidTask

GOAL_RATIO = 1.5
SIDE_BY_SIDE = 50
CALLS = 200


def main() -> int:
    """Run both brains, print the table, return 0 if the goal is met."""
    args, seeds = parse_episodes(__doc__, 200, episode_s=(60.0, "simulated duration of an episode [s]"))
    report = Report(f"{args.episodes} {args.split} random arenas, seed {args.seed}, {args.episode_s:g} s each")
    config, n = TurtleBot3Config(), min(SIDE_BY_SIDE, len(seeds))
    scores, failures = [], []
    for brain in (AvoidanceBrain(), GapFollowerBrain()):
        simulation = Simulation(config, n)
        task = AvoidTask(AvoidConfig(duration_s=args.episode_s), n, config.fps)
        outcomes = [one.outcome for one in run(simulation, task, brain, seeds)]
        add_success(report, brain.name, outcomes)
        scores.append(np.array([outcome.score for outcome in outcomes]))
        failures.append(sum(not outcome.success for outcome in outcomes))
        report.add(f"{brain.name}: mean score", mean(asdict(statistics.mean(scores[-1]))))
        state = simulation.observe().state
        times = {n: act_ms(brain, simulation.observation_names, state, n) for n in (1, 64)}
        report.add(f"{brain.name}: a call, for 1 and 64 robots", f"{times[1]:.3f} ms, {times[64]:.2f} ms")
    ratio = statistics.ratio_of_means(scores[1], scores[0], within=SCORE_RANGE)
    what = "gap_follower / avoidance: mean score, paired"
    report.add(what, mean(asdict(ratio)), f"at least {GOAL_RATIO}", met=ratio.value >= GOAL_RATIO)
    old, new = failures
    allowed = old // 3 if old > 0.05 * args.episodes else old
    report.add("gap_follower: failures", str(new), f"at most {allowed}", met=new <= allowed)
    return report.end(args.json)


def act_ms(brain: Brain, names: tuple[str, ...], state: np.ndarray, n: int) -> float:
    """Return the median time of a call for n robots [ms]."""
    brain.reset(np.arange(n), [0] * n, n)
    observation = Observation(names, np.resize(state, (n, state.shape[1])))
    return float(np.median([seconds(lambda: brain.act(observation)) for _ in range(CALLS)])) * 1e3


if __name__ == "__main__":
    sys.exit(main())
