"""Episodes a second of `bhd-record --engine=ray`: `python -m benchmarks.cluster`.

Two workers of this machine against one, each one process with one thread, and one worker against the same episodes in
one process without Ray. TurtleBot3, `gap_follower`, episodes of full length. The cluster is started once and its
workers are kept: what is measured is recording, from handing out the first episode to having saved the last. What a
start costs is printed beside it. They run in turns; the first turn is not counted.
"""

import os
import sys
import tempfile
import time
from functools import partial
from pathlib import Path

# Before anything imports numpy or torch: one worker is one processor.
os.environ["OMP_NUM_THREADS"] = "1"

from rich.console import Console

from benchmarks._report import Report, parse_options
from benchmarks._turns import in_turns, shown, spread
from bhd_lerobot.cluster.config import RayConfig
from bhd_lerobot.cluster.loop import ClusterLoop, open_pool
from bhd_lerobot.cluster.pool import WorkerPool
from bhd_lerobot.options.parse import parse
from bhd_lerobot.recording.config import RecordConfig
from bhd_lerobot.registry import make_brain, make_robot, make_task
from bhd_lerobot.rollout.episode import EpisodeLoop
from bhd_lerobot.rollout.provenance import episode_metadata
from bhd_lerobot.rollout.recorder import Recording, open_recorder, save_episode
from bhd_lerobot.rollout.tolerance import TimingTolerance
from bhd_lerobot.rollout.types import EpisodeSpec
from bhd_lerobot.tasks.task import episode_seed

GOAL = 1.7  # two workers against one


def configuration(root: Path, episode_s: float) -> RecordConfig:
    """Return what is recorded."""
    return parse(
        RecordConfig,
        [
            "--robot.type=turtlebot3",
            "--task.type=avoid",
            "--brain.type=gap_follower",
            "--dataset.repo_id=bench/cluster",
            f"--dataset.root={root}",
            f"--dataset.episode_time_s={episode_s}",
            "--engine=ray",
        ],
    )


def record(config: RecordConfig, pool: WorkerPool | None, episodes: int) -> float:
    """Record into a new dataset; return how long it took to run and save all episodes [s]."""
    assert config.brain is not None
    simulation = make_robot(config.robot, 1, 1)
    task, brain = make_task(config.task, 1, config.dataset.fps), make_brain(config.brain)
    loop = EpisodeLoop(simulation, task, brain)
    if pool is not None:
        loop = ClusterLoop(
            simulation, task, brain, TimingTolerance(), pool=pool, config=config, brain_config=config.brain
        )
    specs = [EpisodeSpec(index, episode_seed(0, index, "train")) for index in range(episodes)]
    with tempfile.TemporaryDirectory() as folder:
        recording = Recording(
            "bench/cluster", Path(folder) / "data", config.dataset.fps, config.task, config.seed, config.split
        )
        recorder = open_recorder(recording, simulation, task, brain)
        started = time.perf_counter()
        for episode in loop.run(specs, open_images=recorder.begin_episode):
            save_episode(
                recorder,
                episode,
                episode_metadata(episode, split="train", task=task.parameters(), brain=brain.parameters()),
            )
        took = time.perf_counter() - started
        if recorder.num_episodes != episodes:
            raise AssertionError(f"{recorder.num_episodes} of {episodes} episodes were saved.")
        recorder.finalize()
    simulation.close()
    return took


def main() -> int:
    """Print what was measured; return 3 if the goal was missed."""
    options = parse_options(__doc__, episodes=60, episode_s=(30.0, "simulated duration of an episode [s]"), turns=5)
    config = configuration(Path("unused"), options.episode_s)
    quiet = Console(quiet=True)
    started = time.perf_counter()
    with (
        open_pool(RayConfig(num_workers=2, address="local"), quiet) as two,
        WorkerPool(RayConfig(num_workers=1), quiet) as one,
    ):

        def turn(pool: WorkerPool | None) -> float:
            if pool is None:
                return record(config, None, options.episodes)
            record(config, pool, 4)  # its workers are there, and have imported everything
            took = record(config, pool, options.episodes)
            pool.__exit__()  # the other's workers need the processors
            return took

        record(config, two, 2)
        start_s = time.perf_counter() - started
        two.__exit__()
        pools = {"alone": None, "one": one, "two": two}
        times = in_turns({name: partial(turn, pool) for name, pool in pools.items()}, options.turns)
    names = {"two": "two workers", "one": "one worker", "alone": "in one process"}
    speeds = {names[name]: [options.episodes / took for took in times[name]] for name in names}
    report = Report(f"{options.episodes} episodes of {options.episode_s:g} s, {os.cpu_count()} processors")
    report.compare("bhd-record --engine=ray", "episodes/s", speeds, ["one worker"], goal=GOAL)
    pairs = zip(times["one"], times["alone"], strict=True)
    overhead_ms = spread([1000 * (one - alone) / options.episodes for one, alone in pairs])
    report.add("one worker against one process, an episode", f"{shown(overhead_ms, '+.1f')} ms")
    report.add("start of the cluster", f"{start_s:.1f} s")
    return report.end(options.json)


if __name__ == "__main__":
    sys.exit(main())
