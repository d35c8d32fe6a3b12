from collections import deque
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bhd_lerobot.control.fifo import CommandFifo, RingReader, StateRing
from bhd_lerobot.errors import ConfigError
from tests.control import support
from tests.forks import Fork

ALL = np.ones(1, np.bool_)


def push(fifo: CommandFifo, number: int, due: int | None = None, mask: np.ndarray | None = None) -> bool:
    values = np.full((fifo.n, fifo.width), float(number))
    return fifo.push(
        number, number if due is None else due, values, np.ones(fifo.n, np.bool_) if mask is None else mask
    )


def pop(fifo: CommandFifo) -> tuple[int, list[int]] | None:
    """The number of the next command, and the simulations that it is for."""
    values, mask = np.zeros((fifo.n, fifo.width)), np.zeros(fifo.n, np.bool_)
    result = fifo.pop(values, mask)
    if result is None:
        return None
    assert (values == result[0]).all()
    return result[0], np.flatnonzero(mask).tolist()


@pytest.mark.law
@given(st.lists(st.booleans(), max_size=60), st.integers(1, 7))
def test_it_behaves_like_a_bounded_queue(pushes: list[bool], capacity: int) -> None:
    fifo, model = CommandFifo(1, 2, capacity), deque[int]()
    for number, is_push in enumerate(pushes):
        if is_push:
            accepted = push(fifo, number)
            assert accepted == (len(model) < capacity)
            if accepted:
                model.append(number)
        else:
            popped = pop(fifo)
            assert popped == ((model.popleft(), [0]) if model else None)
        assert len(fifo) == len(model)
        assert fifo.next_due() == (model[0] if model else None)


@given(st.lists(st.tuples(st.integers(0, 2), st.integers(0, 5), st.booleans()), max_size=40))
def test_simulations_do_not_wait_for_each_other(steps: list[tuple[int, int, bool]]) -> None:
    """Each simulation's commands come out in its own order and when they are due, as from a queue of its own."""
    shared = CommandFifo(3, 1, 64)
    alone = [deque[tuple[int, int]]() for _ in range(3)]
    last_due = [0, 0, 0]
    now = 0
    for number, (sim, delay, is_push) in enumerate(steps, 1):
        if is_push:
            due = max(last_due[sim], now + delay)  # in one simulation due times do not decrease
            last_due[sim] = due
            mask = np.arange(3) == sim
            assert push(shared, number, due, mask)
            alone[sim].append((number, due))
        else:
            now += delay
            taken: list[list[int]] = [[], [], []]
            while (due_next := shared.next_due()) is not None and due_next <= now:
                popped = pop(shared)
                assert popped is not None
                for member in popped[1]:
                    taken[member].append(popped[0])
            for member in range(3):
                expected = []
                while alone[member] and alone[member][0][1] <= now:
                    expected.append(alone[member].popleft()[0])
                assert taken[member] == expected


def test_what_is_dropped_is_counted_and_makes_room() -> None:
    fifo = CommandFifo(2, 1, 3)
    first, both = np.array([True, False]), np.array([True, True])
    for number, mask in enumerate((first, both, first)):
        given = mask.copy()
        assert push(fifo, number, mask=given)
        given[:] = False  # a command is a copy
    assert fifo.drop(np.array([0])).tolist() == [3]
    assert pop(fifo) == (1, [1])
    assert pop(fifo) is None
    assert [push(fifo, number) for number in range(10, 14)] == [True, True, True, False]
    assert fifo.drop(np.array([0, 1])).tolist() == [3, 3]
    assert len(fifo) == 0


def test_a_queue_has_room_and_the_stated_size() -> None:
    for n in (1, 3, 64):
        size = CommandFifo.nbytes(n, 2, 4)
        fifo = CommandFifo(n, 2, 4, bytearray(size))
        assert [push(fifo, number) for number in range(5)] == [True] * 4 + [False]
        with pytest.raises(ValueError, match="buffer"):
            CommandFifo(n, 2, 4, bytearray(size - 1))
    for make in (lambda: CommandFifo(1, 2, 0), lambda: StateRing(np.dtype(np.float64), 0)):
        with pytest.raises(ConfigError, match="0"):
            make()


def test_a_queue_between_two_processes_loses_and_reorders_nothing(tmp_path: Path) -> None:
    count = 1000
    path = tmp_path / "block"
    reader = CommandFifo(
        *support.FIFO_SHAPE, buffer=support.shared_block(path, CommandFifo.nbytes(*support.FIFO_SHAPE))
    )
    process = Fork(support.push_commands, path, count)
    for number in range(count):
        while (popped := pop(reader)) is None:
            assert process.poll() is None or len(reader) > 0
        assert popped == (number, [sim for sim in range(3) if number % (sim + 1) == 0])
    assert process.wait() == 0
    assert pop(reader) is None


def test_the_ring_keeps_the_newest_and_hands_out_copies() -> None:
    ring = StateRing(support.STATE, 4)
    assert ring.latest() is None
    state = np.zeros((), support.STATE)
    states = []
    for number in range(1, 11):
        state["number"] = number
        state["copies"] = number
        ring.publish(state)
        assert len(ring) == number
        latest = ring.latest()
        assert latest is not None
        states.append(latest)
    assert [int(each["number"]) for each in states] == list(range(1, 11))
    assert all((each["copies"] == each["number"]).all() for each in states)


def test_a_reader_that_is_interrupted_by_the_writer_never_sees_half_a_state() -> None:
    """The writer laps the reader in the middle of its copy; the reader notices and reads again."""
    ring = StateRing(support.STATE, 2)
    state = np.zeros((), support.STATE)

    def publish(number: int) -> None:
        state["number"] = number
        state["copies"] = number
        ring.publish(state)

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
                    publish(int(state["number"]) + 1)
                torn["copies"][250:] = -1
            return torn

    publish(1)
    ring._state = Interrupted(ring._state)
    latest = ring.latest()
    assert latest is not None
    assert int(latest["number"]) == 7
    assert (latest["copies"] == 7).all()


def test_states_from_another_process_are_never_torn(tmp_path: Path) -> None:
    count = 20_000
    path = tmp_path / "block"
    ring = StateRing(support.STATE, 2, support.shared_block(path, StateRing.nbytes(support.STATE, 2)))
    process = Fork(support.publish_states, path, count)
    last = 0
    while last < count:
        latest = ring.latest()
        if latest is None:
            assert process.poll() is None or len(ring)
            continue
        assert (latest["copies"] == latest["number"]).all()
        assert int(latest["number"]) >= last
        last = int(latest["number"])
    assert process.wait() == 0


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
