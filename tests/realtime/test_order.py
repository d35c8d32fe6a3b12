"""What another process may see while something is written, if the processor keeps the order of stores at fences only.

Between two fences any of the stores may be seen and others not: every memory that is possible is made, and read.
"""

import random
from collections.abc import Callable, Iterator
from functools import partial
from itertools import pairwise

import numpy as np
import pytest

from bhd_lerobot.control.commands import BrainCommand
from bhd_lerobot.control.fifo import CommandFifo, RingReader, StateRing, ends
from bhd_lerobot.control.kernels import Fence, as_objects, fence, native_fence
from bhd_lerobot.control.motion.planner import Plan
from bhd_lerobot.control.motion.trajectory import State
from bhd_lerobot.realtime.mailbox import Mailbox
from bhd_lerobot.realtime.planning_link import PlanningLink, PlanServer
from tests.control import support
from tests.realtime.mail_support import DURATION_S, RECORD, RampPlanner, record
from tests.realtime.test_mailbox import number_of

pytestmark = pytest.mark.law
STATE = State.of(*np.arange(21.0).reshape(3, 7))
GOAL = BrainCommand("a", gripper=0.5, timeout_s=5.0)  # five ticks, see `RampPlanner`


def memories(memory: bytearray, write: Callable[[], object], monkeypatch: pytest.MonkeyPatch) -> Iterator[bytearray]:
    """Yield what another process may see of a memory while it is written."""
    stages = [bytes(memory)]
    with monkeypatch.context() as patch:
        patch.setattr(fence, "order", lambda: stages.append(bytes(memory)))
        write()
    stages.append(bytes(memory))
    rng = random.Random(0)
    for before, after in pairwise(np.frombuffer(stage, np.int64) for stage in stages):
        changed = np.flatnonzero(before != after).tolist()
        chosen = [[], changed, *([one] for one in changed), *(rng.sample(changed, len(changed) // 2) for _ in range(9))]
        for seen in chosen if len(changed) < 50 else [chosen[0], chosen[1], *chosen[-12:]]:
            words = before.copy()
            words[seen] = after[seen]
            yield bytearray(words.tobytes())


def test_no_state_is_seen_before_it_is_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    capacity = 3
    memory = bytearray(StateRing.nbytes(support.STATE, capacity))
    ring, state = StateRing(support.STATE, capacity, memory), np.zeros(1, support.STATE)
    for number in range(8):
        state["number"] = state["copies"] = number
        for seen in memories(memory, lambda: ring.publish(state), monkeypatch):
            reader = StateRing(support.STATE, capacity, seen)
            latest = reader.latest()
            assert latest is None if not number and not len(reader) else latest["number"] == len(reader) - 1  # type: ignore[index]
            for k in range(max(0, len(reader) - capacity), len(reader)):
                one = reader.copy(k)
                assert one is None or (one["number"] == k and (one["copies"] == k).all())


def test_no_record_of_a_mailbox_is_seen_before_it_is_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    memory = bytearray(-(-Mailbox.nbytes(RECORD, 2) // 8) * 8)
    mailbox = Mailbox(RECORD, 2, memory)
    for number in range(6):
        for seen in memories(memory, partial(mailbox.post, record(number)), monkeypatch):
            assert number_of(Mailbox(RECORD, 2, seen).take()) in (None, number)
        for seen in memories(memory, mailbox.take, monkeypatch):
            other = Mailbox(RECORD, 2, seen)
            assert number_of(other.take()) in (None, number)
            assert other.post(record(number + 1))


def test_no_command_is_seen_before_it_is_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    memory = bytearray(CommandFifo.nbytes(1))
    fifo, everyone = CommandFifo(1, 2, buffer=memory), np.ones(1, np.bool_)
    for number in range(4):
        values = np.full((1, 2), 0.1 * number + 0.1)

        def push(number: int = number, values: np.ndarray = values) -> None:
            fifo.push(number, 10 + number, values, everyone)

        for seen in memories(memory, push, monkeypatch):
            queue = CommandFifo(1, 2, buffer=seen).queues[0]
            for k in range(queue["head"]):
                assert (queue["sequence"][k], queue["due_ns"][k], queue["waits"][k]) == (k, 10 + k, 1)
                assert queue["values"][k, :2] == pytest.approx(0.1 * k + 0.1)


def test_no_request_and_no_plan_is_seen_before_it_is_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    def linked() -> tuple[PlanningLink, bytearray]:
        memory = bytearray(-(-PlanningLink.nbytes(6, 7, 100, DURATION_S) // 8) * 8)
        return PlanningLink(memory, 6, 7, 100, duration_s=DURATION_S), memory

    link, memory = linked()
    for seen in memories(memory, lambda: link.request(0, GOAL, STATE, 0.05, 17), monkeypatch):
        planner = RampPlanner()
        PlanServer(seen, planner, duration_s=DURATION_S).serve_once()  # type: ignore[arg-type]
        assert [command.gripper for command in planner.planned] in ([], [0.5])
    server = PlanServer(other := bytearray(memory), RampPlanner(), duration_s=DURATION_S)  # type: ignore[arg-type]
    for seen in memories(other, server.serve_once, monkeypatch):
        asking, its_memory = linked()
        asking.request(0, GOAL, STATE, 0.05, 17)
        its_memory[:] = seen
        plan = asking.poll(0)
        assert plan is None or (isinstance(plan, Plan) and len(plan.rows) == 5)
        if plan is not None:
            np.testing.assert_array_equal(plan.rows[:, 0], STATE.position + 0.5 * np.arange(1, 6)[:, None])


def test_who_reads_has_a_fence_after_the_counter_and_one_before_it_is_looked_at_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ring, mailbox = StateRing(support.STATE, 2), Mailbox(RECORD, 2)
    planner, memory = RampPlanner(), bytearray(PlanningLink.nbytes(6, 7, 100, DURATION_S))
    link = PlanningLink(memory, 6, 7, 100, duration_s=DURATION_S)
    server = PlanServer(memory, planner, duration_s=DURATION_S)  # type: ignore[arg-type]
    reader = RingReader(ring)
    ring.publish(np.zeros(1, support.STATE))
    mailbox.post(record(1))
    link.request(0, GOAL, STATE, 0.05, 17)
    queues = as_objects(CommandFifo(1, 2).queues)
    reads: list[tuple[Callable[[], object], int]] = [(ring.latest, 3), (reader.read, 3), (mailbox.take, 2)]
    reads += [(server.serve_once, 3), (lambda: link.poll(0), 1), (lambda: ends(queues[0]), 1)]
    for read, fences in reads:
        passed: list[int] = []
        with monkeypatch.context() as patch:
            patch.setattr(fence, "order", lambda passed=passed: passed.append(1))
            read()
        assert len(passed) == fences


def test_a_ring_recovers_from_a_count_and_guards_that_another_process_overwrote() -> None:
    memory = bytearray(StateRing.nbytes(support.STATE, 4))
    ring, state = StateRing(support.STATE, 4, memory), np.zeros(1, support.STATE)
    reader, rng, number = RingReader(StateRing(support.STATE, 4, memory)), np.random.default_rng(0), 0
    for garbage in (-1, 2**62, -(2**63), 5, *rng.integers(-(2**63), 2**63, 20)):
        np.frombuffer(memory, np.int64)[:2] = garbage  # the count, and a guard
        while reader.read() is not None:
            pass
        assert ring.latest() is None or ring.latest()["number"] == number - 1  # type: ignore[index]
        for _ in range(4):
            state["number"] = state["copies"] = number
            ring.publish(state)
            assert ring.latest()["number"] == number  # type: ignore[index]
            number += 1
        while reader.read() is not None:
            pass
        ring.publish(state)
        assert reader.read() is not None


def test_a_fence_is_one_in_machine_code_and_outside_of_it() -> None:
    fence.compiled()
    [code] = fence.compiled.inspect_llvm().values()
    assert "fence acq_rel" in code
    native_fence()()
    ordering = Fence("aarch64")
    for _ in range(2):
        ordering()
