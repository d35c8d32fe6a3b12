"""Warnings about a bag of which every message can be read."""

import numpy as np
import pytest

from bhd_lerobot.ros2.bag.importer.diagnostics import pace, pace_warnings, speed_warnings
from bhd_lerobot.ros2.bag.importer.resample import NANO

RECEIVED = np.arange(300) * NANO // 5  # a minute at 5 Hz


@pytest.mark.parametrize("rate", [0.3, 0.9, 1.0, 1.1, 2.0])
def test_the_pace_of_a_simulation_is_seen_through_delays_gaps_and_restarts(rate):
    rng = np.random.default_rng(0)
    stamps = (RECEIVED * rate).astype(np.int64) - rng.integers(30_000_000, 200_000_000, len(RECEIVED))
    stamps[200:] -= 40 * NANO  # a restart
    received = RECEIVED.copy()
    received[100:106] = received[106]  # the network stalls, and several come at once
    received[150:] += 300 * NANO  # a silence, of which the headers know nothing
    assert pace(received, stamps) == pytest.approx(rate, rel=0.03)
    assert bool(pace_warnings({"/scan": pace(received, stamps)})) == (rate != 1.0)


@pytest.mark.parametrize("stamps", [np.zeros(300, np.int64), np.full(300, 7 * NANO), RECEIVED[::-1]])
def test_headers_without_times_have_no_pace(stamps):
    assert pace(RECEIVED, stamps) == 1.0
    assert pace(RECEIVED[:20], RECEIVED[:20] // 2) == 1.0  # four seconds are too few
    assert pace(RECEIVED[:1], RECEIVED[:1]) == pace(RECEIVED[:0], RECEIVED[:0]) == 1.0


def drive(seconds=30.0, rate=30):
    """Return times, speeds and pose of a robot that drives in bends, both ways, and stands for a while."""
    t = np.arange(int(seconds * rate)) / rate
    moving = (t < 10) | (t > 15)
    speeds = np.stack([0.2 * np.cos(0.5 * t) * moving, 2.5 * np.sin(0.7 * t) * moving], axis=1)
    yaw = np.cumsum(speeds[:, 1]) / rate
    x, y = (np.cumsum(speeds[:, 0] * turn(yaw)) / rate for turn in (np.cos, np.sin))
    return (t * NANO).astype(np.int64), speeds, np.stack([x, y, yaw], axis=1)


@pytest.mark.parametrize(
    ("factors", "warnings"),
    [
        ((1, 1), []),
        ((0.8, 1.2), []),  # wheels slip
        ((0, 1), ["linear.x is 0.00 times"]),
        ((1000, 1), ["linear.x is"]),  # mm/s
        ((1, 180 / np.pi), ["angular.z is 57"]),
        ((1, -1), ["angular.z is -1.0"]),
    ],
)
def test_speeds_that_are_not_those_of_the_pose_are_reported(factors, warnings):
    times, speeds, pose = drive()
    pose = pose + np.random.default_rng(0).normal(0, 0.002, pose.shape)
    pose[400:] += [5.0, -3.0, 0.0]  # a reset
    pose[7] = np.nan
    notes = speed_warnings("/odom", times, speeds * factors, pose)
    assert len(notes) == len(warnings)
    assert all(part in note for part, note in zip(warnings, notes, strict=True))


def test_an_unusable_pose_causes_no_warning():
    times, speeds, pose = drive()
    assert speed_warnings("/odom", times, speeds, np.zeros_like(pose)) == []  # never filled in
    assert speed_warnings("/odom", times, speeds, np.full_like(pose, np.nan)) == []
    assert speed_warnings("/odom", times[::-1], speeds * 0, pose) == []
    far = times + np.where(np.arange(len(times)) > 400, 50 * 365 * 86_400 * NANO, 0)  # years cost nothing
    assert speed_warnings("/odom", far, speeds, pose) == []
