"""Where a bag's recording breaks off and begins anew: silences, clocks that go back, drivers that restart."""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.errors import DatasetError
from bhd_lerobot.ros2.bag.importer.resample import CLOCK_STEP_NS, NANO, STEP_BACK_NS, Times, clock_jumps
from bhd_lerobot.ros2.bag.importer.tracks import Array, Track, seconds
from bhd_lerobot.ros2.messages.table import ODOMETRY

_LISTED = 5  # of the same kind, one by one
_MIXED = 0.01  # share of messages whose stamps go back, beyond which (and beyond `_LISTED`) no restart explains it
_ODD = 0.05  # the same of poses that jump

POSE_FACTOR, POSE_SLACK = 1.5, (0.1, 0.3)
"""A pose jumps if it moves by more than this many times what the robot's limits allow, and this much [m, rad].

Wheels slip, times of reception jitter by some messages, and a filter corrects what it has reported.
"""


class Segment(NamedTuple):
    """A part of a bag through which an episode can continue, if nothing is silent: places in the bag's order.

    Attributes:
        first, end: the first message's place, and that of the first one after it.
        why: what began it: ``"start"``, ``"clock"`` or ``"reset"``.
    """

    first: int
    end: int
    why: str

    def mask(self, track: Track) -> NDArray[np.bool_]:
        """Return which messages of a track lie in it, shape (n,)."""
        return (track.order >= self.first) & (track.order < self.end)


def segments(
    tracks: Sequence[Track],
    *,
    stamps: str,
    max_speed: tuple[float, ...] | None,
    max_gap_s: float,
    notes: list[str],
) -> list[Segment]:
    """Return the parts of a bag between its breaks, in order.

    Args:
        max_speed: of the robot forward [m/s] and turning [rad/s], if its pose matters; None if it does not.
    """
    step = CLOCK_STEP_NS if stamps == "receive" else STEP_BACK_NS
    jumps = clock_jumps([track.times for track in tracks], [track.order for track in tracks], step)
    if len(jumps):
        notes.append(f"the clock jumped back {len(jumps)} times; each time a new episode begins")
    found = _cut([Segment(0, np.iinfo(np.int64).max, "start")], dict.fromkeys(jumps.tolist(), "clock"))
    for track in tracks:
        if not track.is_action and track.stamps is not None and track.stamps is not track.times:
            found = _cut(found, dict.fromkeys(_restarts(track, track.stamps, found, notes), "clock"))
    if max_speed is not None:
        found = _cut(found, dict.fromkeys(_resets(tracks, max_speed, max_gap_s, found, notes), "reset"))
    return found


def _cut(parts: list[Segment], places: Mapping[int, str]) -> list[Segment]:
    """Return segments that also begin at some places."""
    result = []
    for part in parts:
        inside = {place: why for place, why in sorted(places.items()) if part.first < place < part.end}
        reasons = [part.why, *inside.values()]
        bounds = pairwise([part.first, *inside, part.end])
        result += [Segment(first, end, why) for (first, end), why in zip(bounds, reasons, strict=True)]
    return result


def _restarts(track: Track, stamps: Times, parts: list[Segment], notes: list[str]) -> list[int]:
    """Return where the clock of a topic's headers begins anew though the recorder's continues.

    So it is when a simulation is restarted. Two clocks in one topic, or stamps that are sometimes unset, go back all
    the time: that is no restart.
    """
    places: list[int] = []
    for part in parts:
        mask = part.mask(track)
        places += clock_jumps([stamps[mask]], [track.order[mask]], STEP_BACK_NS).tolist()
    if len(places) > max(_LISTED, _MIXED * len(stamps)):
        notes.append(f"{track.topic}: its header stamps go back {len(places)} times, which no restart explains; unused")
        return []
    if places:
        notes.append(
            f"{track.topic}: its header stamps jumped back {len(places)} times, as when a simulation or a driver is "
            "restarted; each time a new episode begins"
        )
    return places


def _resets(
    tracks: Sequence[Track], max_speed: tuple[float, ...], max_gap_s: float, parts: list[Segment], notes: list[str]
) -> list[int]:
    """Return where the odometry's pose jumps."""
    track = next(track for track in tracks if {*ODOMETRY} <= {*track.names})
    pose = [track.names.index(name) for name in ODOMETRY]
    begin = min(int(sensor.times.min()) for sensor in tracks)
    places, jumps = [], []
    for part in parts:
        rows = np.flatnonzero(part.mask(track))
        way, turn, took = pose_steps(track.times[rows], track.values[rows][:, pose])
        limits = [POSE_FACTOR * speed * took + slack for speed, slack in zip(max_speed, POSE_SLACK, strict=True)]
        jumped = ((way > limits[0]) | (turn > limits[1])) & (took <= max_gap_s)
        for row in np.flatnonzero(jumped).tolist():
            places.append(int(track.order[rows[row + 1]]))
            jumps.append(
                f"{track.topic}: the pose jumped by {way[row]:.2f} m and {np.degrees(turn[row]):.0f} degrees in "
                f"{took[row]:.3f} s, {seconds(int(track.times[rows[row + 1]]) - begin)} after the start: farther than "
                "the robot drives, as when its driver or a filter is restarted; a new episode begins"
            )
    if len(places) > max(_LISTED, _ODD * len(track.times)):
        raise DatasetError(
            f"The pose of {track.topic} jumps {len(places)} times in {len(track.times)} messages, farther than a robot "
            f"with the limits {max_speed[0]:g} m/s and {max_speed[1]:g} rad/s drives. Is it another robot, or are "
            f"there two publishers? The first: {jumps[0].partition(': ')[2]}. Leave out --odometry, or name another "
            "topic with --odom."
        )
    notes += jumps[:_LISTED] + [f"{track.topic}: {len(jumps) - _LISTED} more such jumps"] * (len(jumps) > _LISTED)
    return places


def silence_notes(sensors: Sequence[Track], start: int, gap: int) -> list[str]:
    """Return, in sentences, where a sensor was silent in a segment: at its beginning, within it, or at its end."""
    received = [track.times for track in sensors if len(track.times)]
    if not received:
        return []
    begin, end = min(int(times[0]) for times in received), max(int(times[-1]) for times in received)
    notes = []
    for track in sensors:
        if not len(track.times):
            if end - begin > gap:  # a restart is seen a moment later by the sensor that is slower
                notes.append(
                    f"{track.topic} was not received in the {seconds(end - begin)} from {seconds(begin - start)} after "
                    "the start on, which are left out"
                )
            continue
        first, last, steps = int(track.times[0]), int(track.times[-1]), np.diff(track.times)
        if first - begin > gap:
            notes.append(
                f"{track.topic} was first received {seconds(first - start)} after the start; {seconds(first - begin)} "
                "in which other sensors were received are left out"
            )
        silent = np.flatnonzero(steps > gap)
        for place in silent[:_LISTED].tolist():
            after = seconds(int(track.times[place]) - start)
            notes.append(
                f"{track.topic} was silent for {seconds(int(steps[place]))} ({after} after the start), or the clock "
                "jumped ahead; a new episode begins"
            )
        notes += [f"{track.topic}: {len(silent) - _LISTED} more such silences"] * (len(silent) > _LISTED)
        if end - last > gap:
            notes.append(
                f"{track.topic} was last received {seconds(last - start)} after the start; {seconds(end - last)} in "
                "which other sensors were received are left out"
            )
    return notes


def pose_steps(times: Times, pose: Array) -> tuple[Array, Array, Array]:
    """Return how far a pose moves and turns from each message to the next [m, rad], and in what time [s]; shape (n-1,).

    Args:
        pose: x, y and yaw, shape (n, 3).
    """
    x, y, yaw = np.diff(pose, axis=0).T
    turn = np.abs((yaw + np.pi) % (2 * np.pi) - np.pi)
    return np.hypot(x, y), turn, np.maximum(np.diff(times), 0) / NANO
