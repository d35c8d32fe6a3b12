"""From messages, which come when they come, to frames, which come at a fixed rate: never looking into the future.

A frame at time T has of each topic the newest message at or before T. Where frames lie depends on earlier messages
only, too: an episode begins when a message of every sensor has been received, and its frames follow at 1 / fps. So
nothing that happens after T changes the frame at T; only that a frame was the last one shows later.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Times = NDArray[np.int64]
"""Times [ns], shape (n,)."""
NANO = 1_000_000_000
STEP_BACK_NS = NANO // 2  # stamps that go back further are of a clock that has jumped; what is less is sorted
CLOCK_STEP_NS = NANO // 20  # the same of the recorder's own clock, which nothing but a jump lets go back
ROUNDING_NS = 1000
"""Times that lie closer to each other are the same: who writes stamps rounds them, from seconds as floats, too."""
_NEARLY_ALL = 0.99


@dataclass(frozen=True)
class Grid:
    """The frames of an episode.

    Attributes:
        ages: of the newest message of each sensor, shape (sensors, frames) [ns].
        why: what began it: ``"start"``, ``"gap"``, ``"clock"`` or ``"reset"``.
    """

    times: Times
    ages: Times
    why: str

    def since(self, first: int) -> "Grid":
        """Return its frames from one on."""
        return Grid(self.times[first:], self.ages[:, first:], self.why)


def message_times(received: Times, stamps: Times | None, policy: str, tolerance_ns: int = NANO // 2) -> Times:
    """Return when messages happened [ns], shape (n,).

    Args:
        policy: ``"header"`` or ``"receive"`` take one of them; ``"auto"`` takes the headers' of a topic if nearly all
            of them are sane: before the message was received, and not by more than the tolerance. Two clocks in one
            topic would mix up its order.
        tolerance_ns: on both sides, for two clocks that differ a little; a tenth of it after the reception.
    """
    if stamps is None or policy == "receive":
        return received
    if policy == "header":
        return stamps
    return stamps if sane(received, stamps, tolerance_ns).mean() >= _NEARLY_ALL else received


def sane(received: Times, stamps: Times, tolerance_ns: int = NANO // 2) -> NDArray[np.bool_]:
    """Return which headers' stamps can be true, shape (n,)."""
    delay = received - stamps
    return (stamps > 0) & (delay <= tolerance_ns) & (delay >= -tolerance_ns // 10)


def apart(one: tuple[Times, Times], other: tuple[Times, Times]) -> int:
    """Return by how much the clock of a topic is ahead of another topic's, if both were received at the same time [ns].

    What the delay on the way adds or takes is some tenths of a second.

    Args:
        one: reception and time of its messages [ns], shape (n,) each.
    """
    received, times = (values[np.argsort(other[0], kind="stable")] for values in other)
    both = (one[0] >= received[0]) & (one[0] <= received[-1])
    if not both.any():
        return 0
    begin = int(received[0])  # small numbers: those since 1970 are too large for a float
    ahead = np.interp(one[0][both] - begin, received - begin, times - received)
    return int(np.median(one[1][both] - one[0][both] - ahead))


def clock_jumps(times: Sequence[Times], order: Sequence[Times], step_ns: int = STEP_BACK_NS) -> Times:
    """Return where the clock jumped back: places in the bag's order, of the first message after each jump."""
    if not any((np.diff(reading) < -step_ns).any() for reading in times):
        return np.zeros(0, np.int64)  # a bag may also have been written topic by topic
    places = np.concatenate(list(order))
    by_place = np.argsort(places, kind="stable")
    clock, places = np.concatenate(list(times))[by_place], places[by_place]
    jumps, begin = [], 0
    while len(clock) > begin:
        behind = np.maximum.accumulate(clock[begin:]) - clock[begin:] > step_ns
        if not behind.any():
            break
        begin += int(behind.argmax())
        jumps.append(int(places[begin]))
    return np.array(jumps, np.int64)


def newest(times: Times, at: Times) -> NDArray[np.intp]:
    """Return the place of the newest message at or before each time, shape (frames,); -1 where there is none.

    Times that differ by `ROUNDING_NS` or less are the same.

    Args:
        times: of the messages, ascending.
    """
    return np.searchsorted(times, at + ROUNDING_NS, side="right") - 1


def newest_before(times: Times, at: Times) -> NDArray[np.intp]:
    """Return the place of the newest message before each time, and not at it; otherwise like `newest`."""
    return np.searchsorted(times, at - ROUNDING_NS, side="left") - 1


def frame_times(first: int, count: int, fps: float) -> Times:
    """Return when frames begin at a fixed rate [ns], shape (count,); each is rounded for itself."""
    return first + np.round(np.arange(count) * (NANO / fps)).astype(np.int64)


def grids(sensors: Sequence[Times], fps: float, *, max_age_ns: int, max_gap_ns: int, why: str = "start") -> list[Grid]:
    """Return the frames of the episodes that some sensors allow.

    An episode continues as long as every sensor was received within the last `max_gap_ns`. Frames at its end that only
    have readings older than `max_age_ns` are left out.
    """
    if not sensors or any(not len(times) for times in sensors):
        return []
    last = max(int(times[-1]) for times in sensors)
    result = []
    for first, until in _common([_covered(times, max_gap_ns) for times in sensors]):
        end = min(until, last)
        at = frame_times(first, int((end - first) * fps / NANO) + 2, fps)
        at = at[at <= end + ROUNDING_NS]
        ages = np.stack([np.maximum(at - times[newest(times, at)], 0) for times in sensors])
        fresh = np.flatnonzero(ages.max(axis=0) <= max_age_ns)
        if len(fresh):
            stop = int(fresh[-1]) + 1
            result.append(Grid(at[:stop], ages[:, :stop], why))
        why = "gap"
    return result


def _covered(times: Times, gap: int) -> list[tuple[int, int]]:
    """Return the spans in which the newest message is not older than a gap."""
    breaks = np.flatnonzero(np.diff(times) > gap)
    begin, end = np.append(0, breaks + 1), np.append(breaks, len(times) - 1)
    return [(int(times[a]), int(times[b]) + gap) for a, b in zip(begin, end, strict=True)]


def _common(spans: Sequence[list[tuple[int, int]]]) -> list[tuple[int, int]]:
    """Return the spans that lie in one of each list."""
    common = spans[0]
    for other in spans[1:]:
        common = [
            (max(a, c), min(b, d)) for a, b in common for c, d in other if max(a, c) <= min(b, d)
        ]  # a handful: one for each gap
    return common
