"""Steps a second of the environments: `python -m benchmarks.envs`.

64 avoid environments as one `BhdVectorEnv`, beside (a) the bare `Batch.step` and scans of such a run again, and
(b) Gymnasium's `SyncVectorEnv` and `AsyncVectorEnv` of the single environment. They run in turns, a short while each;
the table shows medians, and medians of the ratios within a turn, because a noisy neighbour disturbs all of a turn.
"""

import multiprocessing
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from multiprocessing import forkserver
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv

from benchmarks._report import Report, parse_options
from benchmarks._turns import in_turns
from bhd_lerobot.envs.config_env import BhdEnvConfig

# Not imported here: the recorder and the rest that only the measuring process needs. Every process of `AsyncVectorEnv`
# imports this module anew, and 64 of them would be busy with that for minutes.

GOAL = 0.70  # of the bare physics and scans
BARE_FRAMES = 200
OURS, BARE = "BhdVectorEnv", "Batch.step and lidar alone"
PEERS = {"SyncVectorEnv": "sync", "AsyncVectorEnv": "async"}
TASK = "TurtleBot3Avoid-v0"
# What a process of `AsyncVectorEnv` needs, imported once, before the processes part.
PRELOADED = (
    "bhd_lerobot.envs.config_env",
    "bhd_lerobot.envs.episodes",
    "bhd_lerobot.robots.turtlebot3",
    "benchmarks.envs",
)


class TooLateError(Exception):
    """Something did not come up in time."""


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
    """Return the same for the physics steps and the scans alone, of such a run."""
    from benchmarks._bare_physics import again, write_down

    log, state = write_down(TASK, actions(n), BARE_FRAMES)

    def run(seconds: float) -> float:
        steps, used = 0, 0.0
        while used < seconds:
            used += again(log, state)
            steps += BARE_FRAMES * n
        return steps / used

    return run


@contextmanager
def time_limit(seconds: float, what: str) -> Iterator[None]:
    """Raise `TooLateError` in the block when so many seconds are over; processes that it started are ended then."""

    def late(*_: Any) -> None:
        raise TooLateError(f"{what} did not come up within {seconds:.0f} s")

    before = multiprocessing.active_children()
    handler = signal.signal(signal.SIGALRM, late)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    except TooLateError:
        for process in multiprocessing.active_children():
            if process not in before:
                process.kill()
        raise
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, handler)


def make(kind: str, n: int) -> VectorEnv:
    """Return n environments side by side, as `kind` does that."""
    env = BhdEnvConfig(task=TASK, vector=kind).create_envs(n)["bhd"][0]
    if env.metadata["autoreset_mode"] != AutoresetMode.SAME_STEP:
        raise AssertionError("All of them are measured in the same autoreset mode.")
    return env


def start(names: list[str], n: int, limit_s: float) -> tuple[dict[str, VectorEnv], dict[str, str]]:
    """Make ours and Gymnasium's; return them by name, and what did not come up in time, with the reason."""
    multiprocessing.set_forkserver_preload(list(PRELOADED))
    forkserver.ensure_running()
    envs: dict[str, VectorEnv] = {}
    problems: dict[str, str] = {}
    for name in names:
        try:
            with time_limit(limit_s, f"{n} environments of {name}"):
                env = make(PEERS.get(name, "bhd"), n)
                env.reset(seed=0)
                envs[name] = env
        except (TooLateError, OSError, EOFError) as error:
            if name == OURS:
                raise
            problems[name] = str(error) or type(error).__name__
            print(f"{name} is not measured: {problems[name]}", flush=True)
    return envs, problems


def summarise(speeds: dict[str, list[float]], problems: dict[str, str], n: int) -> Report:
    """Return what was measured."""
    what, report = f"{n} avoid environments", Report(f"{TASK}, {n} environments")
    peers = [BARE, *(name for name in PEERS if name in speeds)]
    report.compare(what, "steps/s", speeds, peers, goal=GOAL, form=",.0f")
    for name, reason in problems.items():
        report.add(f"{what}: {OURS} / {name}", f"not measured: {reason}")
    return report


def main() -> int:
    """Print the table; return 3 if the goal was missed."""
    kinds = list(PEERS.values())
    options = parse_options(
        __doc__,
        n=(64, "environments"),
        repeats=(7, "turns"),
        seconds=(3.0, "length of each part of a turn"),
        peers={"nargs": "*", "choices": kinds, "default": kinds, "help": "Gymnasium's"},
        limit=(300.0, "longest time for one of them to come up [s]"),
    )
    # The processes come first: they part from one that has no threads yet.
    names = [name for name, kind in reversed(PEERS.items()) if kind in options.peers]
    envs, problems = start([*names, OURS], options.n, options.limit)
    try:
        parts = {name: stepper(env) for name, env in reversed(envs.items())} | {BARE: bare(options.n)}
        timed = {name: partial(run, options.seconds) for name, run in parts.items()}
        speeds = in_turns(timed, options.repeats, uncounted=0)
    finally:
        for env in envs.values():
            env.close()
    return summarise(speeds, problems, options.n).end(options.json)


if __name__ == "__main__":
    sys.exit(main())
