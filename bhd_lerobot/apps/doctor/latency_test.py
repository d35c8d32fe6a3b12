"""How punctually this machine wakes a process up: a loop on an absolute grid that does nothing else.

A real-time process imports this: neither torch nor LeRobot, and no MuJoCo.
"""

import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from bhd_lerobot.realtime.grid import TickGrid
from bhd_lerobot.realtime.privileges import Privileges, RealtimeSettings

BINS_US = (10, 20, 50, 100, 200, 500, 1_000, 2_000, 5_000, 10_000)
"""Upper edges of the histogram's bins [µs]; a last bin holds the rest."""

_WARM_UP = 50  # points of the grid, not counted: the first passes touch memory and code for the first time


def walk_grid(points: int, period_ns: int, clock: Callable[[], int], sleep: Callable[[float], None]) -> list[int]:
    """Wake up at points of a grid [ns]; return how late each wake-up was [ns]. A point that has passed is skipped."""
    grid, lateness = TickGrid(clock() + period_ns, period_ns), []
    while grid.executed + grid.skipped < points:
        due, now = grid.next_due_ns, clock()
        if now < due:
            sleep((due - now) / 1e9)
            now = clock()
        lateness.append(max(0, now - due))
        grid.begin(now)
    return lateness


def summarise(lateness: Sequence[int], rate: int, points: int) -> dict[str, Any]:
    """Return what a walk along a grid of so many points has shown, as plain values.

    These are ``missed``, the points that had passed when the loop got to them, ``p50``, ``p99`` and ``max`` of the
    lateness [s], which is given in nanoseconds, and ``histogram``, the wake-ups in each bin.
    """
    p50, p99 = np.quantile(lateness, (0.50, 0.99), method="inverted_cdf") / 1e9
    bins = np.searchsorted(np.array(BINS_US) * 1_000, lateness, side="left")
    return {
        "rate": rate,
        "points": points,
        "missed": points - len(lateness),
        "p50": float(p50),
        "p99": float(p99),
        "max": max(lateness) / 1e9,
        "histogram": np.bincount(bins, minlength=len(BINS_US) + 1).tolist(),
        "bins_us": BINS_US,
    }


def measure(rate: int, seconds: float) -> dict[str, Any]:
    """Measure for some seconds, with what this process is granted of what the real-time cerebellum asks for."""
    points, period_ns = max(1, round(rate * seconds)), round(1e9 / rate)
    with Privileges() as privileges:
        grants = privileges.acquire(RealtimeSettings())
        walk_grid(_WARM_UP, period_ns, time.monotonic_ns, time.sleep)
        lateness = walk_grid(points, period_ns, time.monotonic_ns, time.sleep)
    return {**summarise(lateness, rate, points), "grants": [grant.as_dict() for grant in grants]}
