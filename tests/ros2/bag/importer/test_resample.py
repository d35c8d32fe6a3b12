"""Resampling: nothing that comes later changes a frame; scanners of every kind become ours."""

import itertools

import numpy as np
import pytest

from bhd_lerobot.bodies.turtlebot3 import turtlebot3_burger
from bhd_lerobot.errors import DatasetError
from bhd_lerobot.ros2.bag.importer.resample import NANO, apart, frame_times, grids, message_times, newest, newest_before
from bhd_lerobot.ros2.messages.scan import Sweep, clean_ranges, nearest_beams, resampled_scans
from tests.cases import each_case

MS = 10**6
START = 1_700_000_000 * NANO
STRAIGHT = tuple(np.eye(3).reshape(-1).tolist())
LIDAR = turtlebot3_burger().lidar
assert LIDAR is not None

GEOMETRY = ("angle_min", "angle_increment", "range_min", "range_max")
REACH = {"range_min": np.array([0.12]), "range_max": np.array([3.5])}


@each_case("fps", [1, 7, 24, 29, 30, 60, 333, 1000])
@each_case("offset_s", [0.0, 0.123456789])
@each_case("writer", ["rounded", "floored", "float seconds", "sums of periods"])
def test_messages_at_a_fixed_rate_are_one_a_frame_however_their_times_were_rounded(fps, offset_s, writer):
    n = 700
    begin = START + round(offset_s * NANO)
    number = np.arange(n)
    times = {
        "rounded": lambda: begin + np.round(number / fps * NANO).astype(np.int64),
        "floored": lambda: begin + number * NANO // fps,
        "float seconds": lambda: np.round((begin / NANO + number / fps) * NANO).astype(np.int64),
        "sums of periods": lambda: begin + number * round(NANO / fps),  # drifts by half a nanosecond a frame
    }[writer]()
    [grid] = grids([times, times + 3], fps, max_age_ns=5 * NANO, max_gap_ns=5 * NANO)
    assert len(grid.times) == n
    ends = frame_times(int(grid.times[0]), n + 1, fps)[1:]
    assert newest(times, grid.times).tolist() == number.tolist()
    assert newest_before(times, ends).tolist() == number.tolist()
    assert (grid.ages >= 0).all()


def test_years_between_two_messages_cost_nothing():
    times = np.array([0, 100 * MS, 50 * 365 * 86400 * 10**9, 50 * 365 * 86400 * 10**9 + 100 * MS])
    assert [len(grid.times) for grid in grids([times], 10, max_age_ns=300 * MS, max_gap_ns=10**9)] == [5, 2]
    assert grids([times, times[:0]], 10, max_age_ns=1, max_gap_ns=1) == []
    assert grids([times[:2], times[2:]], 10, max_age_ns=10**9, max_gap_ns=10**9) == []


def test_clocks_are_compared_at_the_same_time():
    rng = np.random.default_rng(0)
    slow, fast = (START + np.arange(count) * step for count, step in ((40, 200_000_000), (100, 33_000_000)))
    late = (slow + rng.integers(0, 200_000_000, len(slow)), slow)
    assert abs(apart(late, (fast, fast))) < 150_000_000
    assert abs(apart((fast, fast), late)) < 150_000_000
    hour = 3600 * NANO
    assert apart((fast, fast + hour), (slow, slow)) == hour
    assert apart((slow, slow), (fast, fast + hour)) == -hour
    # Both are of a simulation at half the speed: their delays grow, and are the same at the same time.
    half = [(at, START + (at - START) // 2) for at in (fast, slow)]
    assert abs(apart(half[0], half[1])) < 10
    assert apart((fast, fast), (slow + hour, slow)) == 0  # never received together


def test_stamps_of_headers_count_where_they_are_sane():
    received = np.array([1000, 2000, 3000, 4000]) * MS
    stamps = np.array([990, 0, 9000, 3400]) * MS
    assert message_times(received, stamps, "auto") is received  # two clocks in one topic would mix up its order
    earlier = received - 10 * MS
    assert message_times(received, earlier, "auto") is earlier
    assert message_times(received, stamps, "header") is stamps
    assert message_times(received, stamps, "receive") is received
    assert message_times(received, None, "header") is received


@pytest.mark.law
def test_ranges_without_a_return_read_the_maximum_and_what_is_too_near_the_minimum():
    raw = np.array([0.0, np.inf, np.nan, -1.0, -np.inf, 0.05, 0.119, 0.13, 3.5, 8.0], np.float32)
    far, near = LIDAR.range_max, LIDAR.range_min
    clean = clean_ranges(raw, LIDAR, 0.1)
    assert clean == pytest.approx([far, far, far, far, near, near, near, 0.13, far, far])
    assert clean_ranges(np.array([0.2]), LIDAR, 0.25) == [near]


@pytest.mark.parametrize(("range_min", "range_max"), [(0.0, 2.0), (np.nan, 2.0), (0.12, 2.0)])
def test_readings_beyond_the_range_of_the_scanner_are_no_return(range_min, range_max):
    """By ROS's rule such a reading is none: some drivers write range_max + 1 where nothing came back."""
    raw = np.array([0.0, 0.05, 1.9, 2.0, 2.1, 3.0, np.inf], np.float32)
    far, near = LIDAR.range_max, LIDAR.range_min
    assert clean_ranges(raw, LIDAR, range_min, range_max) == pytest.approx([far, near, 1.9, 2.0, far, far, far])
    for unset in (0.0, -1.0, np.nan, np.inf):
        assert clean_ranges(raw[4:6], LIDAR, 0.12, unset) == pytest.approx([2.1, 3.0])


def world(angle):
    return 1.5 + 0.5 * np.cos(angle) + 0.3 * np.sin(2 * angle)


@pytest.mark.law
def test_scanners_of_every_kind_become_ours_by_angle():
    for count, angle_min, sign, beams in itertools.product(
        [360, 361, 230, 720], [0.0, -np.pi, 0.3], [1, -1], [360, 36]
    ):
        step = sign * 2 * np.pi / (count - 1 if count == 361 else count)
        angle = angle_min + step * np.arange(count)
        geometry = {"angle_min": np.array([angle_min]), "angle_increment": np.array([step])} | REACH
        found = resampled_scans(
            world(angle)[None], geometry, lidar=LIDAR, beams=beams, rotation=np.eye(3), topic="/scan"
        )
        wanted = 2 * np.pi * np.arange(beams) / beams
        # Off by at most half a measured step, and the world's slope is below 1.1 m/rad.
        assert np.abs(found[0] - world(wanted)).max() <= 1.1 * abs(step) / 2 + 1e-9, (count, angle_min, sign, beams)


def test_a_scanner_that_does_not_see_all_around_is_refused():
    with pytest.raises(DatasetError, match=r"cover 270 degrees .* 87 of the 360"):
        nearest_beams(Sweep(271, -np.radians(135), np.radians(1)), 360, STRAIGHT, "/scan")
    for count in (1, 2, 8, 17):
        with pytest.raises(DatasetError, match="have no beam within reach of"):
            nearest_beams(Sweep(count, 0.0, 2 * np.pi / count), 360, STRAIGHT, "/scan")


def test_a_scan_that_is_none_counts_as_lost():
    geometry = {name: np.array([0.0, 0.1, np.nan]) for name in GEOMETRY}
    ranges = np.empty(3, object)
    ranges[:] = [np.ones(4), np.ones(0), np.ones(4)]
    found = resampled_scans(ranges, geometry, lidar=LIDAR, beams=4, rotation=np.eye(3), topic="/scan")
    assert np.isnan(found).all()


def scans(rows, **changes):
    """Resample scans of a beam for each degree, with some geometry changed."""
    n = len(rows)
    geometry = {
        "angle_min": np.zeros(n), "angle_increment": np.full(n, np.radians(1.0)), "range_min": np.full(n, 0.12),
        "range_max": np.full(n, 3.5)
    } | changes  # fmt: skip
    return resampled_scans(rows, geometry, lidar=LIDAR, beams=360, rotation=np.eye(3), topic="/scan")


def test_a_part_of_a_turn_is_a_lost_scan_and_no_free_space():
    whole = np.full(360, 2.0)
    found = scans(np.array([whole, whole[:348], whole], dtype=object))
    assert np.isnan(found[1]).all()
    assert (found[[0, 2]] == 2.0).all()
    with pytest.raises(DatasetError, match="cover 347 degrees"):
        scans(np.array([whole, whole[:348], whole[:348]], dtype=object))


def test_angles_that_cannot_be_true_are_no_scan():
    whole = np.full(360, 2.0)
    step = np.radians([1.0, 1.4, 1.6])  # the second goes on a little after its turn
    found = scans(np.stack([whole] * 3), angle_increment=step)
    assert (found[:2] == 2.0).all()
    assert np.isnan(found[2]).all()
    with pytest.raises(DatasetError, match=r"360 beams .* lie 1 rad apart"):  # a driver that writes degrees
        scans(np.stack([whole] * 3), angle_increment=np.ones(3))


def test_empty_bins_are_no_free_space():
    """Drivers sort points into bins; one that got none is not a number."""
    scan = np.full(360, 0.5)
    scan[[10, 50, 51, 359]] = np.nan
    assert (scans(scan[None]) == 0.5).all()
    scan[100:120] = np.nan  # no such bin: nothing came back from there
    assert (scans(scan[None])[0, 100:120] == LIDAR.range_max).all()
    scan[200:203] = np.nan  # nor is this
    assert (scans(scan[None])[0, 199:204] == [0.5, *[LIDAR.range_max] * 3, 0.5]).all()
