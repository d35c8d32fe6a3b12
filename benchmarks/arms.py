"""The scripted brains of the UR5 on held-out seeds: `python -m benchmarks.arms`.

Success of reach, of pick without and with domain randomisation, and of the language brain, with Wilson intervals and
causes of failure. Exits with 3 if a goal is missed.
"""

import json
import sys
import time

from benchmarks._episodes import add_success, parse_episodes, run
from benchmarks._report import Report
from bhd_lerobot.policies.brain import Brain
from bhd_lerobot.policies.language.language_brain import LanguageBrain
from bhd_lerobot.policies.manipulation.pick import PickBrain
from bhd_lerobot.policies.manipulation.reach import ReachBrain
from bhd_lerobot.robots.config_ur import UR5Config
from bhd_lerobot.robots.host.simulation import Simulation
from bhd_lerobot.tasks.pick import PickConfig, PickTask
from bhd_lerobot.tasks.reach import ReachConfig, ReachTask
from bhd_lerobot.tasks.task import Task
from bhd_lerobot.tasks.variation import RandomisationConfig

SIDE_BY_SIDE = 32
_FPS = UR5Config().fps


def cases(n: int) -> dict[str, tuple[Task, Brain, float]]:
    """Return the task, the brain and the least share of successes of each case, with n simulations side by side."""
    wild = PickConfig(randomisation=RandomisationConfig(enabled=True))
    return {
        "reach": (ReachTask(ReachConfig(), n, _FPS), ReachBrain(), 0.998),
        "pick": (PickTask(PickConfig(), n, _FPS), PickBrain(), 0.98),
        "pick, randomised": (PickTask(wild, n, _FPS), PickBrain(), 0.95),
        "pick, by language": (PickTask(PickConfig(language="any"), n, _FPS), LanguageBrain(), 0.98),
    }


def main() -> int:
    """Run the cases, print the table, return 0 if every goal is met."""
    args, seeds = parse_episodes(__doc__, 1000, case=("", "only the cases whose name holds this"))
    report = Report(f"{args.episodes} {args.split} episodes, seed {args.seed}")
    n = min(SIDE_BY_SIDE, len(seeds))
    for name, (task, brain, goal) in cases(n).items():
        if args.case not in name:
            continue
        started = time.perf_counter()
        episodes = run(Simulation(UR5Config(), n), task, brain, seeds)
        took = time.perf_counter() - started
        add_success(report, name, [episode.outcome for episode in episodes], goal)
        seconds = sum(episode.frames for episode in episodes) / _FPS
        report.add(f"{name}: mean time; times real time", f"{seconds / len(episodes):.2f} s; {seconds / took:.0f} x")
        for episode in episodes:
            if not episode.outcome.success:
                why = episode.plan.get("problem") or [end.message for _, end in episode.results if not end.success]
                print(f"{name}, episode {episode.spec.index}: {episode.outcome.event.cause}; {json.dumps(why)}")
    return report.end(args.json)


if __name__ == "__main__":
    sys.exit(main())
