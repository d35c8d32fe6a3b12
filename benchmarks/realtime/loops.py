"""A plain Python loop on an absolute grid, one physics step of the UR5 a tick, in a process of its own.

As a program it does in Python what twin.cpp does in C++, and writes the same records: `python -m
benchmarks.realtime.loops OUT PERIOD_NS TICKS WARM_UP_TICKS PRIORITY [--beside-busy-thread]`. It imports neither torch
nor LeRobot. With the last option it is the benchmark's negative control: a thread of pure Python runs in its process.
"""

import argparse
import ctypes
import gc
import json
import os
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

UNWANTED = ("torch", "lerobot")
_MCL_CURRENT, _MCL_FUTURE, _PR_SET_TIMERSLACK = 1, 2, 29


def run_grid(
    tick: Callable[[], object],
    period_ns: int,
    records: NDArray[np.int64],
    now: Callable[[], int] = time.monotonic_ns,
    sleep: Callable[[float], object] = time.sleep,
) -> tuple[int, int]:
    """Run ticks on an absolute grid; on overrun keep the phase and skip the points of the grid that have passed.

    Args:
        tick: what to do.
        period_ns: the grid's period [ns].
        records: gets due, woke and ended of each tick executed [ns]; its length is the number of points of the grid.
        now: the clock [ns].
        sleep: waits for some seconds.

    Returns:
        Ticks executed and points of the grid skipped, with those that passed during the last tick.
    """
    points = len(records)
    executed = 0
    start = now() + period_ns
    point = 0
    while point < points:
        due = start + point * period_ns
        wait = due - now()
        if wait > 0:
            sleep(wait * 1e-9)
        woke = now()
        tick()
        ended = now()
        record = records[executed]
        record[0], record[1], record[2] = due, woke, ended
        executed += 1
        point = max(point + 1, (ended - start) // period_ns + 1)
    return executed, point - executed


def request_real_time(priority: int) -> tuple[str, list[str]]:
    """Ask the system for locked memory and SCHED_FIFO, for the calling thread.

    Returns:
        The scheduling policy that it runs under, and what was refused.
    """
    refused = []
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mlockall(_MCL_CURRENT | _MCL_FUTURE) != 0:
        refused.append(f"mlockall: {os.strerror(ctypes.get_errno())}")
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority))
    except OSError as error:
        refused.append(f"SCHED_FIFO: {error.strerror}")
        libc.prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0)
        return "SCHED_OTHER", refused
    return "SCHED_FIFO", refused


def _spin() -> None:
    value = 1
    while True:
        value = value * 1_103_515_245 + 12_345 & 0x7FFFFFFF


def main() -> int:
    """Run the loop and write its records."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    for name in ("period_ns", "ticks", "warm_up_ticks", "priority"):
        parser.add_argument(name, type=int)
    parser.add_argument("--beside-busy-thread", action="store_true")
    options = parser.parse_args()

    from benchmarks.realtime.stage import settled_robot

    world = settled_robot(round(1e9 / options.period_ns)).world
    records = np.zeros((options.ticks, 3), np.int64)
    warm_up = np.zeros((options.warm_up_ticks, 3), np.int64)
    if options.beside_busy_thread:
        threading.Thread(target=_spin, daemon=True).start()
    gc.collect()
    gc.freeze()
    gc.disable()
    scheduler, refused = request_real_time(options.priority)
    run_grid(world.step, options.period_ns, warm_up)
    executed, skipped = run_grid(world.step, options.period_ns, records)
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    world.check()
    records[:executed].tofile(options.out)
    unwanted = sorted(set(UNWANTED) & set(sys.modules))
    print(json.dumps({"skipped": skipped, "scheduler": scheduler, "refused": refused, "unwanted": unwanted}))
    return 0


if __name__ == "__main__":
    sys.exit(main())
