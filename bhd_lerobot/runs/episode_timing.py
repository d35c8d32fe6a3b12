"""From what was measured while an episode ran to its timing columns and its timing summary."""

from collections.abc import MutableMapping

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Body, MobileBase, Rates
from bhd_lerobot.control.timing import Clock, TimingStatistics, TimingSummary
from bhd_lerobot.control.tolerance import FrameTiming, TimingTolerance, late_frames
from bhd_lerobot.data import features as keys


def close_timing(
    columns: MutableMapping[str, NDArray],
    statistics: TimingStatistics,
    tolerance: TimingTolerance,
    rates: Rates,
    *,
    clock: Clock,
    sensor_period_s: float = 0.0,
    drops: int = 0,
) -> TimingSummary:
    """Flag the frames of an episode that are out of tolerance, in `control.late`, and return the episode's summary.

    On the lockstep clock the timing columns that are missing are filled with zeros and no frame is flagged.

    Args:
        columns: the episode's columns by key, each of shape (frames, ...); `control.late` is written.
        statistics: the episode's control ticks.
        tolerance: what is tolerated.
        rates: the robot's.
        clock: whose time it is.
        sensor_period_s: time between two readings of the slowest sensor [s], see `sensor_period`.
        drops: frames or states that were lost, and counted.
    """
    length = len(columns[keys.TIME])
    if clock == "lockstep":
        for key in keys.PUNCTUALITY:
            columns.setdefault(key, np.zeros(length, keys.SCALARS[key][0]))
        columns[keys.LATE] = np.zeros(length, np.bool_)
    else:
        frames = FrameTiming(*(columns[key] for key in (keys.TIME, keys.AGE, keys.LATENESS, keys.SKIPPED)))
        columns[keys.LATE] = late_frames(frames, tolerance, rates, sensor_period_s)
    return statistics.summary(
        clock=clock,
        age=columns[keys.AGE],
        inference_time=columns[keys.INFERENCE_TIME],
        late=columns[keys.LATE],
        drops=drops,
        tolerated=None if clock == "lockstep" else tolerance.limits(rates, sensor_period_s),
    )


def sensor_period(body: Body) -> float:
    """Return the time between two readings of a body's slowest sensor [s]; 0 if all are read at every tick."""
    if isinstance(body, MobileBase) and body.lidar is not None:
        return 1.0 / body.lidar.rate_hz
    return 0.0
