"""How punctually this machine wakes a process up: a loop on an absolute grid that does nothing else.

A real-time process imports this: neither torch nor LeRobot, and no MuJoCo.
"""

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.realtime.privileges import Privileges, RealtimeSettings

BINS_US = (10, 20, 50, 100, 200, 500, 1_000, 2_000, 5_000, 10_000)
"""Upper edges of the histogram's bins [µs]; a last bin holds the rest."""

_WARM_UP = 50  # points of the grid, not counted: the first passes touch memory and code for the first time


@dataclass(frozen=True)
class Latency:
    """What was measured. Lateness is the time from a point of the grid to the wake-up.

    Attributes:
        rate: points of the grid a second [Hz].
        points: points of the grid.
        missed: points that had passed when the loop got to them.
        p50: half the wake-ups were no later [s].
        p99: 99 % of the wake-ups were no later [s].
        max: the latest wake-up [s].
        histogram: wake-ups in each bin of `BINS_US`, and later ones.
    """

    rate: int
    points: int
    missed: int
    p50: float
    p99: float
    max: float
    histogram: tuple[int, ...]


def walk_grid(
    lateness: NDArray[np.int64], period_ns: int, clock: Callable[[], int], sleep: Callable[[float], None]
) -> int:
    """Wake up at every point of a grid. A point that has passed is skipped; the grid's phase is kept.

    Args:
        lateness: filled with the lateness of each wake-up [ns]; its length is the number of points.
        period_ns: distance of the points [ns].
        clock: the time [ns].
        sleep: waits for a number of seconds.

    Returns:
        The number of wake-ups, at most the number of points.
    """
    start = clock() + period_ns
    point = woken = 0
    while point < len(lateness):
        due = start + point * period_ns
        now = clock()
        if now < due:
            sleep((due - now) / 1e9)
        late = max(0, clock() - due)
        lateness[woken] = late
        woken += 1
        point += 1 + late // period_ns
    return woken


def summarise(lateness: NDArray[np.int64], rate: int, points: int) -> Latency:
    """Return what a walk along a grid has shown.

    Args:
        lateness: of every wake-up [ns], shape (wake-ups,), at least one.
        rate: points a second [Hz].
        points: points of the grid.
    """
    p50, p99 = np.quantile(lateness, (0.50, 0.99), method="inverted_cdf") / 1e9
    bins = np.searchsorted(np.array(BINS_US) * 1_000, lateness, side="left")
    return Latency(
        rate=rate,
        points=points,
        missed=points - len(lateness),
        p50=float(p50),
        p99=float(p99),
        max=float(lateness.max()) / 1e9,
        histogram=tuple(np.bincount(bins, minlength=len(BINS_US) + 1).tolist()),
    )


def measure(rate: int, seconds: float) -> dict[str, Any]:
    """Measure in this process, with what it is granted of what the real-time cerebellum asks for.

    Args:
        rate: points of the grid a second [Hz].
        seconds: length of the measurement [s].

    Returns:
        The fields of a `Latency`; `bins_us`, the edges of its histogram; `grants`, what became of each request.
    """
    lateness = np.zeros(max(1, round(rate * seconds)), np.int64)
    period_ns = round(1e9 / rate)
    with Privileges() as privileges:
        grants = privileges.acquire(RealtimeSettings())
        walk_grid(lateness[:_WARM_UP].copy(), period_ns, time.monotonic_ns, time.sleep)
        woken = walk_grid(lateness, period_ns, time.monotonic_ns, time.sleep)
    measured = asdict(summarise(lateness[:woken], rate, len(lateness)))
    return {**measured, "bins_us": BINS_US, "grants": [grant.as_dict() for grant in grants]}
