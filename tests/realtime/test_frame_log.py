"""Frames from states: what the recorder keeps whatever it loses, on made-up ticks."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from bhd_lerobot.control.fifo import StateRing
from bhd_lerobot.realtime.frame_log import FrameCollector, FrameLog

STATE = np.dtype([(name, np.int64) for name in ("tick", "segment", "due_ns", "start_ns", "executed")])
F = 5  # ticks in a frame


class Rig:
    def __init__(self, ring: int = 64, frames: int = 64) -> None:
        self.ring = StateRing(STATE, ring)
        self.log = FrameLog(STATE, frames)
        self.collector = FrameCollector(self.ring, self.log, F)
        self.reader = self.log.reader()
        self.published = {0: 0}

    def tick(self, tick: int, segment: int = 1, lateness: int = 0) -> None:
        executed = self.published.setdefault(segment, 0)
        self.published[segment] += 1
        self.ring.publish(np.array((tick, segment, 1000 * tick, 1000 * tick + lateness, executed), STATE))

    def boundaries(self) -> list[tuple[int, int]]:
        found = []
        while (entry := self.reader.read()) is not None:
            found.append((int(entry["frame"]), int(entry["state"]["tick"])))
        return found


def test_the_lateness_of_a_frame_is_in_its_boundary() -> None:
    rig = Rig()
    for tick in range(-1, 2 * F):
        rig.tick(tick, lateness={2: 70, 3: 40, F: 5}.get(tick, 1))
    rig.collector.drain()
    entries = []
    while (entry := rig.reader.read()) is not None:
        entries.append(int(entry["lateness_ns"]))
    assert entries == [1, 70, 5]


@given(
    ticks=st.lists(st.integers(1, 3 * F), max_size=40),
    chunks=st.lists(st.integers(1, 30), min_size=1, max_size=10),
    capacity=st.integers(2, 40),
)
def test_every_boundary_is_recorded_or_its_absence_is_explained(
    ticks: list[int], chunks: list[int], capacity: int
) -> None:
    rig = Rig(ring=capacity)
    tick, published = -1, []
    for number, step in enumerate(ticks):
        rig.tick(tick)
        published.append(tick)
        tick += step  # a step of more than 1: ticks that the loop skipped
        if number % chunks[number % len(chunks)] == 0:
            rig.collector.drain()
    rig.tick(tick)  # drops are known when the next state comes
    published.append(tick)
    rig.collector.drain()
    assert rig.collector.states + rig.collector.drops == len(published)
    found = rig.boundaries()
    assert [frame for frame, _ in found] == sorted({frame for frame, _ in found})
    for frame, at in found:
        assert (at + 1) // F == frame
    if not rig.collector.drops:
        firsts: dict[int, int] = {}
        for at in published:
            firsts.setdefault((at + 1) // F, at)
        assert dict(found) == firsts


def test_a_new_segment_starts_at_frame_0_and_counts_its_own_drops() -> None:
    rig = Rig(ring=8)
    for tick in range(-1, 30):
        rig.tick(tick)
    rig.collector.drain()
    assert rig.collector.drops > 0
    for tick in range(-1, 2):
        rig.tick(tick, segment=2)
    rig.boundaries()
    rig.collector.drain()
    assert rig.boundaries() == [(0, -1)]
    assert (rig.collector.states, rig.collector.drops) == (3, 0)
