"""The navigator on held-out scenes: success, collisions, path length, time: `python -m benchmarks.navigate`.

The goal: at least 99 % success, no collision, and a mean SPL (success weighted by path length) above 0.85. Exits with 3
if it is missed.
"""

import sys
from dataclasses import asdict

import numpy as np

from benchmarks._episodes import add_success, parse_episodes
from benchmarks._report import Report, mean
from bhd_lerobot.evaluation import statistics
from bhd_lerobot.policies.navigation.navigator import NavigatorBrain
from bhd_lerobot.robots.config_turtlebot3 import TurtleBot3Config
from bhd_lerobot.robots.host.simulation import Simulation
from bhd_lerobot.rollout.episode import EpisodeLoop
from bhd_lerobot.rollout.types import EpisodeSpec
from bhd_lerobot.tasks.navigate import NavigateConfig, NavigateTask
from bhd_lerobot.tasks.task import Event, Outcome

GOAL_SUCCESS = 0.99
GOAL_SPL = 0.85
SIDE_BY_SIDE = 50


def main() -> int:
    """Run the brain, print what came of it, return 0 if the goal is met."""
    args, seeds = parse_episodes(__doc__, 500, arena="random")
    task = NavigateConfig(arena=args.arena, random_start=args.arena != "random")
    n = min(SIDE_BY_SIDE, len(seeds))
    outcomes, times = drive(task, seeds, n)
    _, alone = drive(task, seeds[:5], 1)
    report = Report(f"{args.episodes} {args.split} scenes, arena {args.arena}, seed {args.seed}")
    add_success(report, "navigator", outcomes, GOAL_SUCCESS)
    collisions = sum(outcome.event.cause == Event.COLLISION.cause for outcome in outcomes)
    report.add("navigator: collisions", str(collisions), "at most 0", met=not collisions)
    spl = statistics.mean([outcome.score for outcome in outcomes])
    what = "navigator: success weighted by path length, mean"
    report.add(what, mean(asdict(spl)), f"above {GOAL_SPL}", met=spl.value > GOAL_SPL)
    duration = [outcome.details["time_s"] for outcome in outcomes if outcome.success]
    if duration:
        report.add("navigator: time", f"median {np.median(duration):.1f} s, longest {max(duration):.1f} s")
    calls = f"{np.median(alone) * 1e3:.2f} ms, {np.median(times) * 1e3:.2f} ms"
    report.add(f"navigator: a call, for 1 and {n} robots", calls)
    failed = [f"{index} ({one.event.cause})" for index, one in enumerate(outcomes) if not one.success]
    print(*([f"failed: {', '.join(failed)}"] if failed else []))
    return report.end(args.json)


def drive(config: NavigateConfig, seeds: list[int], n: int) -> tuple[list[Outcome], list[float]]:
    """Run the brain in the scenes of these seeds, n side by side; return the outcomes, and the times of its calls."""
    robot = TurtleBot3Config(collision_monitor=True)
    loop = EpisodeLoop(Simulation(robot, n), NavigateTask(config, n, robot.fps), NavigatorBrain())
    episodes = loop.run([EpisodeSpec(index, seed) for index, seed in enumerate(seeds)])
    return [episode.outcome for episode in episodes], loop.act_times


if __name__ == "__main__":
    sys.exit(main())
