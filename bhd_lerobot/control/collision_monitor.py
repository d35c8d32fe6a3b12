"""Keeps bases from driving into what their scans show, whatever commands them."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Drive, LidarSpec
from bhd_lerobot.control.kernels import clamp, kernel, record
from bhd_lerobot.control.messages import NANOSECONDS, Limit
from bhd_lerobot.errors import ConfigError

MARGIN = 0.02  # [m] beside the robot's outline: twice the noise of an LDS-01
_DELAY_S = 0.03  # from a measurement to wheels that brake: two ticks and the servos' time constant, 11 ms
# Of the stopping deceleration. The rest is for what turning adds: 0.22 m/s times 2.84 rad/s bring a return that was
# beside the robot nearer with 0.6 m/s^2.
_SHARE = 0.5
_NEVER = 1e-9
_BESIDE_DEG = 3.0  # two directions that are no farther apart show the same thing
_CLEARANCE = int(Limit.CLEARANCE)
_OLDEST_SCANS = 3  # a scan that is older than so many periods shows nothing of the present


BEAMS = 1024
"""Most ranges of a scan."""
_POINTS = 2 * BEAMS

MONITOR = record(
    "monitor",
    [
        ("beams", np.int64),  # ranges in a scan, counter-clockwise from ahead; 0 if there is no monitor
        ("directions", np.float64, (BEAMS, 2)),
        ("ahead", np.float64),  # [m] the lidar of the middle between the wheels
        ("range_min", np.float64),
        ("range_max", np.float64),
        ("reach", np.float64),  # [m] what is farther cannot matter before the scan is too old
        ("deceleration", np.float64),
        ("oldest_ticks", np.int64),
        ("beside", np.int64),  # beams to each side that show the same thing
        ("rectangles", np.int64),
        ("outline", np.float64, (8, 3)),
        # What was seen: returns in the frame of the odometry [m], and whether they are nearer than can be measured.
        ("seen_ns", np.int64),
        ("age", np.int64),  # [ticks]
        ("count", np.int64),
        ("points", np.float64, (_POINTS, 2)),
        ("is_too_near", np.int8, (_POINTS,)),
        ("is_hidden", np.int8, (BEAMS,)),
    ],
)


def new_monitors(drive: Drive, lidar: LidarSpec, n: int, control_hz: int, beams: int) -> NDArray:
    """Return the records of what keeps n bases from driving into what their scans show, shape (n,).

    The speed at which a return comes nearer to the robot's outline may be no larger than what can be braked on the way
    that is left; what leads away from it is free. Yaw rates come first, because turning is what avoids an obstacle, and
    are limited where a corner would sweep over something. Returns stay where they were seen, by odometry, until the
    next scan, and those that have come too near to be measured for as long as they are. Without a scan of the last
    three periods a base does not move.

    It knows what the lidar sees: nothing below or above its plane, nothing thinner than two beams are apart, and what
    moves only where it was.

    Args:
        drive: limits, radius and outline.
        lidar: the lidar.
        n: number of bases.
        control_hz: ticks a second [Hz].
        beams: ranges in a scan, counter-clockwise from ahead.

    Raises:
        ConfigError: there are more beams, or rectangles of the outline, than a record holds.
    """
    monitors = np.zeros(n, MONITOR)
    if beams > BEAMS or len(drive.outline) > len(monitors["outline"][0]):
        raise ConfigError(
            f"The collision monitor takes up to {BEAMS} beams and an outline of 8 rectangles; the robot has {beams} "
            f"and {len(drive.outline)}."
        )
    angle = 2 * np.pi * np.arange(beams) / beams
    fastest, deceleration = drive.limits.velocity[0], _SHARE * drive.limits.stop_deceleration[0]
    way = fastest * (_OLDEST_SCANS / lidar.rate_hz + _DELAY_S) + fastest**2 / (2 * deceleration)
    monitors["beams"], monitors["ahead"] = beams, lidar.ahead
    monitors["directions"][:, :beams] = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    monitors["range_min"], monitors["range_max"] = lidar.range_min, lidar.range_max
    monitors["reach"], monitors["deceleration"] = drive.radius + MARGIN + way, deceleration
    monitors["oldest_ticks"] = round(_OLDEST_SCANS * control_hz / lidar.rate_hz)
    monitors["beside"] = round(math.radians(_BESIDE_DEG) / (2 * np.pi) * beams)
    monitors["rectangles"] = len(drive.outline)
    monitors["outline"][:, : len(drive.outline)] = drive.outline
    forget_scans(monitors, np.arange(n))
    return monitors


def forget_scans(monitors: NDArray, ids: NDArray[np.intp]) -> None:
    """Forget the scans of bases that were put somewhere else."""
    monitors["count"][ids], monitors["seen_ns"][ids] = 0, -1
    monitors["age"][ids] = monitors["oldest_ticks"][ids] + 1


@kernel()
def keep_clear(state: Any, limits: Any, monitor: Any, ranges: NDArray[np.float64], stamp_ns: int) -> None:
    """Take a new scan, and take away speed and yaw rate of the command.

    Args:
        ranges: the newest scan, and more [m].
        stamp_ns: when it was taken: one that is not new is not taken again.
    """
    monitor.age += 1
    if stamp_ns != monitor.seen_ns:
        see(state, limits, monitor, ranges, stamp_ns)
    cos, sin = math.cos(state.odometry[2]), math.sin(state.odometry[2])
    up, down, turn_up, turn_down = np.inf, np.inf, np.inf, np.inf
    for number in range(monitor.count):
        _, lever, speed = approach(state, monitor, number, cos, sin)
        turn_up = min(turn_up, speed / max(lever, _NEVER))
        turn_down = min(turn_down, speed / max(-lever, _NEVER))
    # Turning comes first: it is what avoids an obstacle. What it leaves is for driving.
    first = limits.arm_values
    yaw_rate = clamp(state.command[first + 1], -turn_down, turn_up)
    for number in range(monitor.count):
        ahead, lever, speed = approach(state, monitor, number, cos, sin)
        speed = max(speed - lever * yaw_rate, 0.0)
        up, down = min(up, speed / max(ahead, _NEVER)), min(down, speed / max(-ahead, _NEVER))
    if monitor.age > monitor.oldest_ticks:
        up = down = turn_up = turn_down = 0.0
    for k in range(2):
        # No harder than a stop: what appears nearer than that is not avoided.
        most = max(turn_up if k else up, state.before[k] - limits.stop[k])
        least = min(-turn_down if k else -down, state.before[k] + limits.stop[k])
        limited = max(min(state.command[first + k], most), least)
        if limited != state.command[first + k]:
            state.command[first + k], state.limits = limited, state.limits | _CLEARANCE
            state.rate[k] = 0.0  # the next change starts anew: such a large one could not end in time


@kernel()
def see(state: Any, limits: Any, monitor: Any, ranges: NDArray[np.float64], stamp_ns: int) -> None:
    """Remember the near returns of a scan, and those of the last which have come too near to be measured."""
    x, y, yaw, age = state.odometry[0], state.odometry[1], state.odometry[2], 0.0
    if limits.has_stamps:
        age = (state.stamp_ns - stamp_ns) / NANOSECONDS
        left, right = state.velocity[limits.arm_values], state.velocity[limits.arm_values + 1]
        forward, turned = (left + right) * limits.half_radius * age, (right - left) * limits.turn * age
        x -= forward * math.cos(yaw - turned / 2)
        y -= forward * math.sin(yaw - turned / 2)
        yaw -= turned
    # A scan that is no measurement, or from the future, is not taken: the last gets old, and the base stops.
    old = np.rint(age * limits.hz)  # [ticks]
    is_taken = old >= -1.0
    for beam in range(monitor.beams):
        is_taken &= math.isfinite(ranges[beam])
    if not is_taken:
        return
    monitor.seen_ns, monitor.age = stamp_ns, int(min(max(old, 0.0), 1e9))
    cos, sin, beams = math.cos(yaw), math.sin(yaw), monitor.beams
    for beam in range(beams):
        monitor.is_hidden[beam] = ranges[beam] <= monitor.range_min
    # Of the last, what is hidden now is kept in front of the list.
    kept = 0
    for number in range(monitor.count):
        dx, dy = monitor.points[number, 0] - x, monitor.points[number, 1] - y
        angle = math.atan2(dy * cos - dx * sin, dx * cos + dy * sin - monitor.ahead)
        beam = int(np.rint(angle / (2 * math.pi) * beams))
        is_kept = False
        for one in range(beam - monitor.beside, beam + monitor.beside + 1):
            is_kept |= ranges[one % beams] <= monitor.range_min
        if not is_kept or monitor.is_too_near[number] or kept >= _POINTS - beams:
            continue
        for one in range(beam - monitor.beside, beam + monitor.beside + 1):
            monitor.is_hidden[one % beams] = False
        monitor.points[kept, 0], monitor.points[kept, 1] = monitor.points[number, 0], monitor.points[number, 1]
        monitor.is_too_near[kept] = False
        kept += 1
    most = min(monitor.reach + abs(monitor.ahead), monitor.range_max)
    for beam in range(beams):
        is_unknown = monitor.is_hidden[beam]
        if is_unknown or monitor.range_min < ranges[beam] < most:
            ahead = ranges[beam] * monitor.directions[beam, 0] + monitor.ahead
            to_left = ranges[beam] * monitor.directions[beam, 1]
            monitor.points[kept, 0], monitor.points[kept, 1] = (
                x + ahead * cos - to_left * sin,
                y + ahead * sin + to_left * cos,
            )
            monitor.is_too_near[kept] = is_unknown
            kept += 1
    monitor.count = kept


@kernel()
def approach(state: Any, monitor: Any, number: int, cos: float, sin: float) -> tuple[float, float, float]:
    """Return how a return comes nearer to the outline, and how fast it may.

    Args:
        cos: of the yaw; `sin` likewise.

    Returns:
        By how much it comes nearer for each metre that is driven, and for each radian that is turned [m]; and the
        largest speed at which it may [m/s].
    """
    dx, dy = monitor.points[number, 0] - state.odometry[0], monitor.points[number, 1] - state.odometry[1]
    ahead, left = dx * cos + dy * sin, dy * cos - dx * sin
    distance, to_x, to_y = np.inf, 0.0, 0.0  # from the nearest point of the outline
    for one in range(monitor.rectangles):
        off_x = ahead - clamp(ahead, monitor.outline[one, 0], monitor.outline[one, 1])
        off_y = left - clamp(left, -monitor.outline[one, 2], monitor.outline[one, 2])
        apart = math.sqrt(off_x * off_x + off_y * off_y)  # numba's hypot has other last digits than Python's
        if apart < distance:
            distance, to_x, to_y = apart, off_x, off_y
    if distance < 1e-6:  # inside there is no direction out of it: away from the middle
        to_x, to_y = ahead, left
    length = max(math.sqrt(to_x * to_x + to_y * to_y), 1e-6)
    to_x, to_y = to_x / length, to_y / length
    way = 0.0 if monitor.is_too_near[number] else max(distance - MARGIN, 0.0)
    # The largest v with v * delay + v^2 / (2 deceleration) = way.
    slope = monitor.deceleration * _DELAY_S
    return to_x, to_y * ahead - to_x * left, math.sqrt(slope * slope + 2.0 * monitor.deceleration * way) - slope
