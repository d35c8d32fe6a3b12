import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bhd_lerobot.control.fifo import CommandFifo, RingReader, StateRing, drop, find_next, keep_newest
from bhd_lerobot.control.kernels import as_objects
from bhd_lerobot.control.record import NEVER, new_states
from bhd_lerobot.errors import ConfigError
from tests.control import support


def push(fifo: CommandFifo, number: int, due: int | None = None, mask: np.ndarray | None = None) -> list[bool]:
    mask = np.ones(fifo.n, np.bool_) if mask is None else mask
    values = np.full((fifo.n, fifo.width), float(number))
    pushed: list[bool] = fifo.push(number, number if due is None else due, values, mask).tolist()
    return pushed


class Reader:
    """The end of the queues that a tick has."""

    def __init__(self, fifo: CommandFifo) -> None:
        self.fifo, self.records = fifo, new_states(fifo.n)
        self.states, self.queues = as_objects(self.records), as_objects(fifo.queues)

    def next_due(self, sim: int = 0) -> int | None:
        find_next(self.states[sim], self.queues[sim])
        due = self.states[sim].next_due_ns
        return None if due == NEVER else due

    def pop(self, sim: int = 0) -> int | None:
        """Take the next command of a robot; return its number."""
        if self.next_due(sim) is None:
            return None
        entry = self.states[sim].next_entry
        number = int(self.queues[sim].sequence[entry])
        assert (self.queues[sim].values[entry, : self.fifo.width] == number).all()
        self.queues[sim].waits[entry] = False
        find_next(self.states[sim], self.queues[sim])
        return number

    def drop(self, sim: int = 0) -> int:
        return int(drop(self.states[sim], self.queues[sim], -(2**63), NEVER))


@pytest.mark.law
@given(st.lists(st.tuples(st.integers(0, 2), st.integers(0, 5), st.booleans()), max_size=100), st.integers(1, 7))
def test_commands_come_out_when_they_are_due_and_simulations_do_not_wait_for_each_other(
    steps: list[tuple[int, int, bool]], capacity: int
) -> None:
    """Each simulation has a queue of its own, with as much room as is stated."""
    shared, waiting, now = CommandFifo(3, 1, capacity), [list[tuple[int, int]]() for _ in range(3)], 0
    reader = Reader(shared)
    for number, (sim, delay, is_push) in enumerate(steps, 1):
        if is_push:
            is_taken = push(shared, number, now + delay, np.arange(3) == sim)[sim]
            assert is_taken == (len(waiting[sim]) < capacity)
            waiting[sim] += [(now + delay, number)] * is_taken
            continue
        now += delay
        for member in range(3):
            while (due := reader.next_due(member)) is not None and due <= now:
                waiting[member].sort()
                assert (due, reader.pop(member)) == waiting[member].pop(0)
            assert all(due > now for due, _ in waiting[member])


def test_what_is_dropped_is_counted_and_makes_room() -> None:
    fifo = CommandFifo(2, 1, 3)
    reader = Reader(fifo)
    for number, both in enumerate((False, True, False)):
        assert push(fifo, number, mask=np.array([True, both])) == [True, both]
    assert reader.drop() == 3
    assert [reader.pop(), reader.pop(1), reader.pop(1)] == [None, 1, None]
    assert [push(fifo, number)[0] for number in range(10, 14)] == [True, True, True, False]
    assert [reader.drop(sim) for sim in (0, 1, 0)] == [3, 3, 0]
    assert len(fifo) == 0


@given(st.lists(st.tuples(st.integers(0, 9), st.integers(-3, 3)), max_size=30), st.integers(-3, 3))
def test_of_what_is_due_the_newest_is_kept_and_of_numbers_those_out_of_a_range(
    entries: list[tuple[int, int]], now: int
) -> None:
    for judge in ("due", "numbers"):
        fifo = CommandFifo(1, 1)
        reader = Reader(fifo)
        for number, due in entries:
            push(fifo, number, due)
        if judge == "due":
            keep_newest(reader.states[0], reader.queues[0], now)
            left = [one for one in entries if one[1] > now] + [one for one in entries if one[1] <= now][-1:]
        else:
            dropped = drop(reader.states[0], reader.queues[0], 3, 5)
            left = [one for one in entries if not 3 <= one[0] <= 5]
            assert dropped == len(entries) - len(left)
        assert sorted(iter(reader.pop, None)) == sorted(number for number, _ in left)


def test_a_command_for_the_end_of_all_time_is_seen_and_does_not_keep_its_place_for_ever() -> None:
    fifo = CommandFifo(1, 1, 4)
    reader = Reader(fifo)
    push(fifo, 1, NEVER)
    assert reader.next_due() == NEVER - 1
    assert [reader.drop(), len(fifo)] == [1, 0]


def test_a_queue_has_room_and_the_stated_size() -> None:
    for n in (1, 3, 64):
        size = CommandFifo.nbytes(n)
        fifo = CommandFifo(n, 2, 4, bytearray(size))
        assert [push(fifo, number) for number in range(5)] == [[True] * n] * 4 + [[False] * n]
        with pytest.raises(ValueError, match="buffer"):
            CommandFifo(n, 2, 4, bytearray(size - 1))
    for make in (lambda: CommandFifo(1, 2, 0), lambda: StateRing(np.dtype(np.float64), 0)):
        with pytest.raises(ConfigError, match="0"):
            make()
    with pytest.raises(ConfigError, match="257; it must be from 1 to 256"):
        CommandFifo(1, 2, 257)


def test_a_reader_that_is_interrupted_by_the_writer_never_sees_half_a_state() -> None:
    """The writer laps the reader in the middle of its copy; the reader notices and reads again."""
    ring = StateRing(support.STATE, 2)

    class Interrupted:
        """Slots whose first copy is made while the writer writes."""

        def __init__(self, slots: np.ndarray) -> None:
            self.slots, self.interruptions = slots, 0

        def __getitem__(self, slot: int) -> "Interrupted":
            self.slot = slot
            return self

        def __setitem__(self, slot: int, value: np.ndarray) -> None:
            self.slots[slot] = value

        def copy(self) -> np.ndarray:
            torn = self.slots[self.slot].copy()
            if self.interruptions < 3:
                self.interruptions += 1
                for _ in range(2):
                    support.publish(ring, len(ring) + 1)
                torn[2000:] = 255
            return torn

    support.publish(ring, 1)
    ring._rows = Interrupted(ring._rows)
    latest = ring.latest()
    assert latest is not None
    assert int(latest["number"]) == 7
    assert (latest["copies"] == 7).all()


@given(steps=st.lists(st.tuples(st.integers(0, 12), st.integers(0, 12)), max_size=40), capacity=st.integers(2, 7))
def test_a_reader_gets_every_state_once_in_order_or_counts_it(steps: list[tuple[int, int]], capacity: int) -> None:
    dtype = np.dtype([("value", np.int64)])
    ring = StateRing(dtype, capacity)
    published = 0
    for _ in range(3):  # what is there before a reader is none of its business
        ring.publish(np.array((-1,), dtype))
    reader = RingReader(ring)
    seen: list[int] = []
    for writes, reads in steps:
        for _ in range(writes):
            ring.publish(np.array((published,), dtype))
            published += 1
        for _ in range(reads):
            state = reader.read()
            if state is None:
                break
            seen.append(int(state["value"]))
    while (state := reader.read()) is not None:
        seen.append(int(state["value"]))
    assert seen == sorted(set(seen))
    assert len(seen) + reader.drops == published
    assert -1 not in seen
