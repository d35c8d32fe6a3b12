"""How unpunctual a frame, and how many such frames an episode, may be. Pure: judges what was measured."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Rates
from bhd_lerobot.options.declared import Options, Positive, Share, Whole
from bhd_lerobot.realtime.timing import TimingSummary


@dataclass
class TimingTolerance(Options, prefix="timing."):
    """What is tolerated of a robot on the wall clock; without effect on the lockstep clock, which is never late.

    The defaults follow from what a time stands for. A tick, or a frame, is taken to have happened at its place on the
    grid; off by more than half the grid's spacing, it lies nearer to the place of another one. And a brain that gets an
    observation older than a frame sees what it could have seen a frame before.

    Attributes:
        max_lateness_s: how late a control tick may start [s]; half a control period if not set.
        max_age_s: how old the oldest reading of an observation may be when the brain gets it [s]; a frame, and in
            addition a period of the slowest sensor, if not set.
        max_jitter_s: by how much the time between two observations may differ from 1 / fps [s]; half a frame if
            nothing.
        max_skipped: how many control ticks of a frame may have been skipped.
        max_late_frames: share of an episode's frames that may be out of tolerance before the episode counts as bad.
        reject: do not save an episode that counts as bad, but record it again. Otherwise its frames are only flagged,
            in `control.late`.
    """

    max_lateness_s: Positive | None = None
    max_age_s: Positive | None = None
    max_jitter_s: Positive | None = None
    max_skipped: Whole = 0
    max_late_frames: Share = 0.01
    reject: bool = False

    def limits(self, rates: Rates, sensor_period_s: float = 0.0) -> dict[str, float]:
        """Return what is tolerated at some rates: `lateness`, `age`, `jitter` [s], `skipped`, `late_frames` [share].

        Args:
            rates: the robot's.
            sensor_period_s: time between two readings of the slowest sensor [s]; 0 if all are read at every tick.
        """

        def chosen(value: float | None, default: float) -> float:
            return default if value is None else float(value)

        return {
            "lateness": chosen(self.max_lateness_s, 0.5 / rates.control_hz),
            "age": chosen(self.max_age_s, 1.0 / rates.fps + sensor_period_s),
            "jitter": chosen(self.max_jitter_s, 0.5 / rates.fps),
            "skipped": self.max_skipped,
            "late_frames": self.max_late_frames,
        }


@dataclass(frozen=True)
class FrameTiming:
    """What was measured of the frames of an episode.

    Attributes:
        time: when the observation was measured [s], shape (frames,).
        age: age of its oldest reading when the brain got it [s], shape (frames,).
        lateness: largest lateness of a control tick in the frame [s], shape (frames,).
        skipped: control ticks of the frame that were skipped, shape (frames,).
    """

    time: NDArray[np.floating]
    age: NDArray[np.floating]
    lateness: NDArray[np.floating]
    skipped: NDArray[np.integer]


def late_frames(
    frames: FrameTiming, tolerance: TimingTolerance, rates: Rates, sensor_period_s: float = 0.0
) -> NDArray[np.bool_]:
    """Return which frames violate the tolerance, shape (frames,). A value equal to its limit is within it.

    Args:
        frames: what was measured.
        tolerance: what is tolerated.
        rates: the robot's.
        sensor_period_s: time between two readings of the slowest sensor [s]; 0 if all are read at every tick.
    """
    limits = tolerance.limits(rates, sensor_period_s)
    jitter = np.abs(np.diff(np.asarray(frames.time, np.float64), prepend=-np.inf) - 1.0 / rates.fps)
    jitter[:1] = 0.0  # nothing was before the first frame
    late = np.asarray(frames.skipped) > limits["skipped"]
    for name, values in (("lateness", frames.lateness), ("age", frames.age), ("jitter", jitter)):
        # In single precision, as columns are stored: rounding keeps the order, so that no limit turns itself away.
        late |= ~(np.asarray(values, np.float32) <= np.float32(limits[name]))  # what is not a number is not within
    return late


def verdict(summary: TimingSummary, tolerance: TimingTolerance) -> str | None:
    """Return why an episode counts as bad, or None: what was exceeded, by how much, and what to do about it.

    Args:
        summary: of an episode whose late frames are counted.
        tolerance: what is tolerated.
    """
    # A share such as 0.29 of 100 frames must allow 29, though their product in binary is a little less.
    allowed = math.floor(tolerance.max_late_frames * summary.frames + 1e-9)
    if summary.clock == "lockstep" or summary.late_frames <= allowed:
        return None
    limits = summary.tolerated
    found = [
        f"{what} {1e3 * worst:.2f} ms (tolerated {1e3 * limits[name]:.2f} ms)"
        for name, what, worst in (
            ("lateness", "a control tick started late by", summary.lateness_max),
            ("age", "an observation was old by", summary.age_max),
        )
        if name in limits and np.float32(worst) > np.float32(limits[name])
    ]
    if summary.skipped:
        found.append(f"{summary.skipped} control ticks were skipped")
    if not found:
        found.append("observations came at uneven intervals")
    return (
        f"{summary.late_frames} of {summary.frames} frames ({100 * summary.late_frames / summary.frames:.1f} %) are "
        f"out of the timing tolerance; timing.max_late_frames = {tolerance.max_late_frames:g} allows {allowed}. "
        f"Worst: {'; '.join(found)}. Give the control loop its real-time rights (`bhd-doctor --realtime` says which "
        "are missing), take other work off this machine, lower robot.control_hz or robot.fps, or widen --timing.* if "
        "the task can bear it."
    )
