"""Frames from states: what is read, however late, and what is lost, on made-up ticks."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from bhd_lerobot.control.fifo import StateRing
from bhd_lerobot.realtime.frame_reader import Boundary, FrameReader

STATE = np.dtype([(name, np.int64) for name in ("tick", "segment", "due_ns", "start_ns")])
F = 5  # ticks in a frame


class Rig:
    def __init__(self, capacity: int = 64) -> None:
        self.ring = StateRing(STATE, capacity)
        self.reader = FrameReader(self.ring, F)

    def tick(self, tick: int, segment: int = 1, lateness: int = 0) -> None:
        self.ring.publish(np.array((tick, segment, 1000 * tick, 1000 * tick + lateness), STATE))

    def read(self) -> list[Boundary]:
        found = []
        while (boundary := self.reader.read()) is not None:
            found.append(boundary)
        return found


def numbers(found: list[Boundary]) -> list[tuple[int, int]]:
    return [(one.frame, int(one.state["tick"])) for one in found]


def test_the_lateness_of_a_frame_is_in_its_boundary() -> None:
    rig = Rig()
    for tick in range(-1, 2 * F):
        rig.tick(tick, lateness={2: 70, 3: 40, F: 5}.get(tick, 1))
    assert [one.lateness_ns for one in rig.read()] == [1, 70, 5]


@given(
    ticks=st.lists(st.integers(1, 3 * F), max_size=40),
    chunks=st.lists(st.integers(1, 30), min_size=1, max_size=10),
    capacity=st.integers(2, 40),
)
def test_every_boundary_is_read_or_its_absence_is_explained(ticks: list[int], chunks: list[int], capacity: int) -> None:
    rig = Rig(capacity)
    tick, published, found, pause, longest = -1, [], [], 0, 0
    for number, step in enumerate([*ticks, 1]):
        rig.tick(tick)
        published.append(tick)
        tick += step  # a step of more than 1: ticks that the loop skipped
        pause += 1
        longest = max(longest, pause)
        if number % chunks[number % len(chunks)] == 0:
            found += rig.read()
            pause = 0
    rig.tick(F * (tick + F))  # the boundary that says what was lost before it
    published.append(F * (tick + F))
    longest = max(longest, pause + 1)
    found += rig.read()
    assert [one.frame for one in found] == sorted({one.frame for one in found})
    assert all((at + 1) // F == frame for frame, at in numbers(found))
    firsts: dict[int, int] = {}
    for at in published:
        firsts.setdefault((at + 1) // F, at)
    if longest < capacity:  # a pause of less than the ring holds
        assert numbers(found) == list(firsts.items())
    # What was lost is counted: all, or those that are not there any more when the reader comes back.
    lost = found[-1].drops
    assert (lost == 0) == (longest < capacity)
    assert len(set(firsts) - {one.frame for one in found}) <= lost < len(published)


def test_a_new_segment_starts_at_frame_0() -> None:
    rig = Rig(8)
    for tick in range(-1, 30):
        rig.tick(tick)
    assert rig.read()[-1].drops == 31 - 7
    for tick in range(-1, 2):
        rig.tick(tick, segment=2)
    assert numbers(rig.read()) == [(0, -1)]
