"""Steps a second of the environments: `python -m benchmarks.envs`.

64 avoid environments as one `BhdVectorEnv`, beside (a) the bare `Batch.step` with as many physics steps and scans, and
(b) Gymnasium's `SyncVectorEnv` and `AsyncVectorEnv` of the single environment. They run in turns, a short while each;
the table shows medians, and medians of the ratios within a turn, because a noisy neighbour disturbs all of a turn.
"""

import argparse
import statistics
import sys
import time
from collections.abc import Callable

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from rich.console import Console
from rich.table import Table

from benchmarks.record import bare_step
from bhd_lerobot.envs.config_env import BhdEnvConfig

GOAL = 0.70  # of the bare physics and scans
FPS = 10
OURS, BARE = "BhdVectorEnv", "Batch.step and lidar alone"
PEERS = {"SyncVectorEnv": "sync", "AsyncVectorEnv": "async"}


def actions(n: int, frames: int = 64) -> np.ndarray:
    """Return random actions, shape (frames, n, 2)."""
    rng = np.random.default_rng(0)
    return (rng.uniform(-1, 1, (frames, n, 2)) * [0.22, 1.5] * [0.5, 1] + [0.11, 0]).astype(np.float32)


def stepper(env: VectorEnv) -> Callable[[float], float]:
    """Return a function that steps for about so many seconds and returns environment steps a second."""
    rows = actions(env.num_envs)
    env.reset(seed=0)
    count = 0

    def run(seconds: float) -> float:
        nonlocal count
        started, first = time.perf_counter(), count
        while (passed := time.perf_counter() - started) < seconds:
            env.step(rows[count % len(rows)])
            count += 1
        return env.num_envs * (count - first) / passed

    return run


def bare(n: int) -> Callable[[float], float]:
    """Return the same for the physics steps and the scans alone; each scan is worth two frames."""

    def run(seconds: float) -> float:
        steps, used = 0, 0.0
        while used < seconds:
            used += bare_step(n, 2.0)  # building the scenes is not counted
            steps += round(2.0 * FPS) * n
        return steps / used

    return run


def main() -> int:
    """Print the table; return 1 if the goal was missed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--n", type=int, default=64, help="environments")
    parser.add_argument("--repeats", type=int, default=7, help="turns")
    parser.add_argument("--seconds", type=float, default=3.0, help="length of each part of a turn")
    parser.add_argument("--peers", nargs="*", choices=("sync", "async"), default=["sync", "async"], help="Gymnasium's")
    options = parser.parse_args()
    kinds = {OURS: "bhd"} | {name: kind for name, kind in PEERS.items() if kind in options.peers}
    envs = {
        name: BhdEnvConfig(task="TurtleBot3Avoid-v0", vector=kind).create_envs(options.n)["bhd"][0]
        for name, kind in kinds.items()
    }
    for env in envs.values():
        if env.metadata["autoreset_mode"] != AutoresetMode.SAME_STEP:
            raise AssertionError("All of them are measured in the same autoreset mode.")
    parts = {name: stepper(env) for name, env in envs.items()} | {BARE: bare(options.n)}
    speeds: dict[str, list[float]] = {name: [] for name in parts}
    for _ in range(options.repeats):
        for name, run in parts.items():
            speeds[name].append(run(options.seconds))
    for env in envs.values():
        env.close()
    table = Table(title=f"TurtleBot3Avoid-v0, {options.n} environments", title_justify="left")
    for heading in ("measured", "steps per s", "ours is", "goal"):
        table.add_column(heading, justify="left" if heading == "measured" else "right")
    ratios = {}
    for name, values in speeds.items():
        ratios[name] = statistics.median(mine / other for mine, other in zip(speeds[OURS], values, strict=True))
        goal = f">= {GOAL:.2f} x" if name == BARE else ""
        table.add_row(name, f"{statistics.median(values):.0f}", f"{ratios[name]:.2f} x", goal)
    Console(width=100).print(table)
    missed = ratios[BARE] < GOAL
    if missed:
        print(f"Missed: {ratios[BARE]:.2f} of the bare physics with the same lidar.")
    return int(missed)


if __name__ == "__main__":
    sys.exit(main())
