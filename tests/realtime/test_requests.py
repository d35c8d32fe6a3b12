"""A caller and a cerebellum in two parts of a test, on one virtual clock; between them only records in memory."""

from collections import Counter
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bhd_lerobot.control.commands import BrainCommand, CommandResult, ResultCode
from bhd_lerobot.control.messages import NANOSECONDS, Mode, Reason, Request
from bhd_lerobot.errors import RealtimeError
from bhd_lerobot.realtime.mailbox import Mailbox
from bhd_lerobot.realtime.requests import EVENT_DTYPE, RequestClient, RequestKind, RequestServer, request_dtype
from tests.control import arm_rig, support
from tests.control.goal_rig import HZ, joints

TICK_NS = NANOSECONDS // HZ


class Pair:
    """A cerebellum that serves requests every tick, and a client that waits a tick at a time."""

    def __init__(self, capacity: int = 4, events: int = 4, active: bool = True) -> None:
        self.now_ns, self.alive = 0, True
        self.cerebellum = arm_rig.Rig(active=False).cerebellum
        blocks = [bytearray(Mailbox.nbytes(dtype, size)) for dtype, size in self.shapes(capacity, events)]
        ours, theirs = (
            [Mailbox(*shape, block) for shape, block in zip(self.shapes(capacity, events), blocks, strict=True)]
            for _ in range(2)
        )
        self.server = RequestServer(self.cerebellum, *theirs)
        self.requests, self.events = ours
        self.client = RequestClient(*ours, self.tick, 0.1, lambda: self.now_ns)
        if active:
            assert self.client.request(Request.CONFIGURE) == Reason.ACCEPTED
            assert self.client.request(Request.ACTIVATE) == Reason.ACCEPTED

    @staticmethod
    def shapes(capacity: int, events: int) -> list[tuple[np.dtype, int]]:
        return [(request_dtype(6), capacity), (EVENT_DTYPE, events)]

    def tick(self, ticks: int = 1) -> None:
        for _ in range(ticks):
            self.now_ns += TICK_NS
            if self.alive:
                self.server.serve(self.now_ns)
                self.cerebellum.tick(self.now_ns)

    def rest(self) -> None:
        for _ in range(20_000):
            if not self.cerebellum.controller.busy.any():
                self.tick()
                return
            self.tick()
        raise AssertionError("still busy")

    @property
    def mode(self) -> Mode:
        return Mode(int(self.cerebellum.mode[0]))

    def results(self) -> list[tuple[str, ResultCode]]:
        return [(result.task_id, result.code) for result in self.client.take_results()]


def goal(name: str, target: float = 0.2, **fields: Any) -> BrainCommand:
    return BrainCommand(name, joint_target=joints(target), **fields)


@pytest.mark.parametrize("again", [goal("a"), BrainCommand("a", joint_target=(1.0,))], ids=["fits", "does not fit"])
def test_a_duplicate_name_leaves_the_live_goal_its_result(again: BrainCommand) -> None:
    pair = Pair()
    pair.client.submit(goal("a"))
    assert pair.client.submit(again) is not None
    assert pair.results() == []
    pair.rest()
    assert pair.results() == [("a", ResultCode.SUCCEEDED)]
    refusal = pair.client.submit(BrainCommand("a", joint_target=(1.0,)))
    assert refusal is not None
    pair.tick()
    assert pair.client.take_results() == [refusal]


def test_a_goal_ends_by_a_cancel_or_by_an_emergency_stop_which_refuses_others() -> None:
    for code in (ResultCode.CANCELLED, ResultCode.ESTOP):
        pair = Pair()
        pair.client.submit(goal("a", 2.0))
        pair.tick(50)
        if code == ResultCode.CANCELLED:
            assert pair.client.cancel("b") == pair.client.cancel("x" * 65) == ResultCode.UNKNOWN_ID
            assert pair.client.cancel("a") == ResultCode.SUCCEEDED
        else:
            pair.cerebellum.estop.press()
            refusal = pair.client.submit(goal("b"))
            assert refusal is not None
            assert refusal.code == code
        pair.rest()
        assert sorted(pair.results()) == [("a", code), ("b", code)][: 1 + (code == ResultCode.ESTOP)]


def test_a_robot_without_goals_refuses_them_with_a_reason() -> None:
    rig = support.Rig()
    requests, events = Mailbox(request_dtype(0)), Mailbox(EVENT_DTYPE)
    server = RequestServer(rig.cerebellum, requests, events)
    client = RequestClient(requests, events, lambda: server.serve(0), clock_ns=lambda: 0)
    refusal = client.submit(BrainCommand("a", gripper=0.0))
    assert refusal is not None
    assert "takes setpoints" in refusal.message
    assert client.cancel("a") == ResultCode.UNKNOWN_ID
    assert client.request(Request.DEACTIVATE) == Reason.ACCEPTED


@pytest.mark.law
@pytest.mark.parametrize("kind", RequestKind)
def test_a_cerebellum_that_does_not_answer_is_named_and_does_nothing_later(kind: RequestKind) -> None:
    pair = Pair()
    pair.client.submit(goal("live", 2.0))
    pair.tick(50)
    pair.alive = False
    calls = {
        RequestKind.MODE: lambda: pair.client.request(Request.DEACTIVATE),
        RequestKind.GOAL: lambda: pair.client.submit(goal("a")),
        RequestKind.CANCEL: lambda: pair.client.cancel("live"),
    }
    began = pair.now_ns
    with pytest.raises(RealtimeError, match=f"has not answered a {kind.name} request within 0.1 s"):
        calls[kind]()
    assert pair.now_ns - began == pytest.approx(0.1e9, abs=2 * TICK_NS)
    pair.alive = True
    pair.tick(2)
    assert pair.server.expired == 1
    assert pair.mode == Mode.TRACKING
    pair.rest()
    assert pair.results() == [("live", ResultCode.SUCCEEDED)]


def test_garbage_in_a_request_ends_nothing_and_the_next_request_is_answered() -> None:
    random = np.random.default_rng(0)
    pair = Pair()
    for number in range(300):
        record = np.frombuffer(random.bytes(pair.requests.dtype.itemsize), pair.requests.dtype)[0].copy()
        record["expires_ns"] = 2**62
        if number % 2:
            record["kind"], record["mode"] = random.integers(3), random.integers(4)
            record["goal"]["motion"], record["goal"]["name"], record["goal"]["name_size"] = 0, str(number), 3
        assert pair.requests.post(record)
        pair.tick()
        pair.client.take_results()
    assert pair.server.invalid > 100
    pair.tick(200)
    pair.client.request(Request.RESET)
    pair.client.request(Request.ACTIVATE)
    pair.client.submit(goal("a"))
    pair.rest()
    assert pair.results()[-1] == ("a", ResultCode.SUCCEEDED)


def test_a_full_mailbox_is_waited_for_and_then_named() -> None:
    pair = Pair(capacity=2)
    pair.alive = False
    for _ in range(4):
        with pytest.raises(RealtimeError, match="has not answered"):
            pair.client.submit(goal("a"))
    assert len(pair.requests) == 2
    pair.alive = True
    assert pair.client.submit(goal("b")) is None  # behind the two that have expired
    assert pair.server.expired == 2
    pair.rest()
    assert pair.results() == [("b", ResultCode.SUCCEEDED)]


def test_a_reply_that_comes_too_late_is_not_taken_for_another_ones() -> None:
    pair = Pair(events=1)
    pair.client.submit(goal("a", 2.0))
    assert pair.events.post(np.zeros(1, EVENT_DTYPE)[0])  # no room: the request is left where it is
    pair.client._take_events = lambda *_: None  # type: ignore[method-assign]
    with pytest.raises(RealtimeError):
        pair.client.cancel("a")
    del pair.client._take_events
    assert pair.client.cancel("b") == ResultCode.UNKNOWN_ID
    later = RequestClient(pair.requests, pair.events, pair.tick, 0.1, lambda: pair.now_ns)
    record = np.zeros(1, request_dtype(6))[0]
    record["number"], record["expires_ns"], record["mode"] = 1, pair.now_ns + NANOSECONDS, Request.ACTIVATE
    pair.requests.post(record)  # of an earlier client
    pair.tick()
    assert later.cancel("nobody") == ResultCode.UNKNOWN_ID
    pair.rest()
    assert [(result.task_id, result.code) for result in later.take_results()] == [("a", ResultCode.SUCCEEDED)]


def test_results_wait_until_they_are_taken() -> None:
    pair = Pair(events=1)
    due = []
    for number in range(30):
        refusal = pair.client.submit(goal(str(number), 99.0))
        assert isinstance(refusal, CommandResult)
        due.append((str(number), ResultCode.JOINT_LIMIT))
    for number in range(30, 40):
        pair.cerebellum.submit(0, goal(str(number), 99.0))
        due.append((str(number), ResultCode.JOINT_LIMIT))
    pair.tick(100)
    assert len(pair.events) == 1
    taken = []
    for _ in range(60):
        taken += pair.results()
        pair.tick()
    assert taken == due


steps = st.one_of(
    st.tuples(st.just("goal"), st.sampled_from([0.05, -0.1, 99.0]), st.booleans()),
    st.tuples(st.just("cancel"), st.integers(0, 12), st.none()),
    st.tuples(st.just("estop"), st.none(), st.none()),
    st.tuples(st.just("mode"), st.sampled_from(Request), st.none()),
    st.tuples(st.just("take"), st.none(), st.none()),
    st.tuples(st.just("stall"), st.none(), st.none()),
    st.tuples(st.just("tick"), st.integers(1, 120), st.none()),
)


@settings(max_examples=40)
@given(st.lists(steps, max_size=20), st.integers(1, 3), st.integers(1, 3))
def test_every_goal_that_was_answered_has_one_result(script: list, capacity: int, events: int) -> None:
    pair, due, taken = Pair(capacity, events), Counter[str](), Counter[str]()
    for number, (kind, value, extra) in enumerate(script):
        name = str(number)
        if kind == "goal":
            answer = pair.client.submit(goal(name, value, preempt=extra))
            assert answer is None or answer.task_id == name
            due[name] += 1
        elif kind == "cancel":
            pair.client.cancel(str(value))
        elif kind == "estop":
            pair.cerebellum.estop.press()
        elif kind == "mode":
            assert isinstance(pair.client.request(value), Reason)
        elif kind == "take":
            taken.update(result.task_id for result in pair.client.take_results())
        elif kind == "stall":
            pair.alive = False
            with pytest.raises(RealtimeError):
                pair.client.submit(goal(name))
            pair.alive = True
        else:
            pair.tick(value)
    for _ in range(30):
        pair.rest()
        taken.update(result.task_id for result in pair.client.take_results())
    assert taken == due
