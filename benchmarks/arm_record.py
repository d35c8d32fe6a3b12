"""Speed of bhd-record with the UR5, beside the bare physics: `python -m benchmarks.arm_record`.

Simulated seconds in a second of the pick task with everything on (physics, cerebellum, goals, inverse kinematics, task,
brain, recorder, finalising), for 1 and for 32 simulations, beside `Batch.step` alone on the same scenes, taken in turns
in one process; medians. A short run before them, which loads what is loaded at first use, is not counted. Exits with 1
if a goal is missed.
"""

import argparse
import io
import shutil
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from rich.console import Console

from benchmarks.record import paired
from bhd_lerobot.recording.config import RecordConfig
from bhd_lerobot.recording.record import record
from bhd_lerobot.robots.config_ur5 import UR5Config
from bhd_lerobot.robots.ur5_simulation import UR5Simulation
from bhd_lerobot.rollout.configuration import parse
from bhd_lerobot.tasks.pick import PickConfig, PickTask

GOALS = {1: 20.0, 32: 60.0}  # simulations to times real time


def run_record(folder: Path, n: int, episodes: int) -> float:
    """Record the pick task; return simulated seconds in a second."""
    shutil.rmtree(folder, ignore_errors=True)
    config = parse(
        RecordConfig,
        [
            "--config_path=configs/record/ur5_pick.yaml",
            f"--dataset.root={folder / 'dataset'}",
            f"--output_dir={folder / 'run'}",
            "--preview_video=false",
            f"--n_envs={n}",
            f"--dataset.num_episodes={episodes}",
        ],
    )
    result = record(config, Console(file=io.StringIO()))
    return result.simulated_s / result.wall_s


def bare_step(n: int, seconds: float) -> float:
    """Return simulated seconds in a second of the physics alone."""
    simulation = UR5Simulation(UR5Config(), n)
    task = PickTask(PickConfig(), n, simulation.rates.fps)
    simulation.reset(np.arange(n), [task.sample(2 * i) for i in range(n)], range(n))
    steps = round(seconds * simulation.world.physics_hz)
    started = time.perf_counter()
    for _ in range(steps):
        simulation.world.step(1)
    return n * seconds / (time.perf_counter() - started)


def main() -> int:
    """Print the table; return 1 if a goal was missed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=3)
    args = parser.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="bhd-bench-"))
    print(f"{'':12}{'bhd-record':>14}{'bare physics':>16}{'share':>8}{'goal':>10}")
    missed = False
    try:
        for n, episodes in ((1, 24), (32, 256)):
            run_record(folder, n, n)
            mine, bare, share = paired(
                lambda n=n, episodes=episodes: run_record(folder, n, episodes),
                lambda n=n: bare_step(n, 10.0),
                args.repeats,
            )
            missed |= mine < GOALS[n]
            print(f"{f'n_envs = {n}':12}{mine:>12.0f} x{bare:>14.0f} x{share:>8.2f}{GOALS[n]:>8.0f} x")
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    print("GOAL MISSED" if missed else "goals met")
    return int(missed)


if __name__ == "__main__":
    sys.exit(main())
