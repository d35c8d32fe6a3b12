"""Suspicious things in a robot's bag whose messages can all be read: clocks of another pace, speeds in other units.

A dataset can be made of it all the same, so it is printed, not refused.
"""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.ros2.bag.importer.resample import NANO, STEP_BACK_NS, Times

Array = NDArray[np.float64]

_LONG_NS = 10 * NANO  # over less, the delays of single messages count
_JUMP_NS = 2 * NANO  # that one clock gets ahead of the other from one message to the next; a network stalls for less
_PACE = 0.05  # two clocks of one time differ by less than a thousandth
_WINDOW_NS = NANO // 2  # in which a robot moves farther than its sensors' noise, and does not turn round
_MOVED = (0.05, 0.15)  # [m, rad] in a window
_MOVES = 10  # windows
_SAME = (0.5, 2.0)  # ratio of a speed to that of the pose: wheels slip


def pace(received: Times, stamps: Times) -> float:
    """Return by how many seconds the headers of a topic continue in a second of the recorder; 1 if that is not known.

    Args:
        received: when the recorder got the messages [ns], shape (n,), in the order in which they were written.
    """
    by_recorder, by_header = np.diff(received), np.diff(stamps)
    steady = np.minimum(by_recorder, by_header) >= -STEP_BACK_NS
    steady &= np.abs(by_recorder - by_header) < _JUMP_NS
    whole, by_stamps = int(by_recorder[steady].sum()), int(by_header[steady].sum())
    return by_stamps / whole if whole >= _LONG_NS and by_stamps > 0 else 1.0


def pace_warnings(paces: Mapping[str, float]) -> list[str]:
    """Return, in sentences, which topics' headers are of a clock that is slower or faster than the recorder's."""
    other = {topic: pace for topic, pace in paces.items() if abs(pace - 1) > _PACE}
    if not other:
        return []
    topics = ", ".join(f"{topic} ({pace:.2f} s)" for topic, pace in other.items())
    return [
        f"in a second of the recorder the headers do not advance by a second: {topics}. This happens if a simulation "
        "does not keep up with the wall clock, or a bag was played at another rate. In the recorder's time the robot "
        "moves slower or faster than its speeds state; record such a simulation with ros2 bag record --use-sim-time"
    ]


def speed_warnings(topic: str, times: Times, speeds: Array, pose: Array) -> list[str]:
    """Return, in sentences, which of the odometry's speeds are not those at which its pose moves.

    So it is if a driver fills in the pose alone, or writes degrees.

    Args:
        speeds: forward and turning [m/s, rad/s], shape (n, 2).
        pose: x, y and unwrapped yaw [m, m, rad], shape (n, 3).
    """
    finite = np.isfinite(np.concatenate([speeds, pose], axis=1)).all(axis=1)
    times, speeds, pose = times[finite], speeds[finite], pose[finite]
    steps = np.diff(times)
    if not len(steps) or (steps < 0).any():
        return []  # a clock that went back
    way = np.concatenate([np.zeros((1, 2)), np.cumsum((speeds[1:] + speeds[:-1]) / 2 * steps[:, None] / NANO, axis=0)])
    _, first = np.unique((times - times[0]) // _WINDOW_NS, return_index=True)
    whole = np.abs(np.diff(times[first]) - _WINDOW_NS) < _WINDOW_NS // 2  # not across a silence
    x, y, yaw = np.diff(pose[first], axis=0)[whole].T
    by_speed = np.diff(way[first], axis=0)[whole]
    notes = []
    for name, by_twist, by_pose, least in (
        ("linear.x", np.abs(by_speed[:, 0]), np.hypot(x, y), _MOVED[0]),
        ("angular.z", by_speed[:, 1], yaw, _MOVED[1]),
    ):
        moved = np.abs(by_pose) > least
        if int(moved.sum()) < _MOVES:
            continue
        share = float(np.median(by_twist[moved] / by_pose[moved]))
        if not _SAME[0] <= share <= _SAME[1]:
            notes.append(
                f"{topic}: its twist.{name} is {share:.2f} times that of its pose where the robot moves. The "
                "observation is made of the twist; is it filled in, in m/s and rad/s? --odom names another topic"
            )
    return notes
