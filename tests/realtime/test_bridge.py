"""The bridge over shared memory, with both of its ends in one process and on a virtual clock."""

import os
import re
from collections.abc import Iterator
from contextlib import closing
from importlib.metadata import version

import numpy as np
import pytest

from bhd_lerobot.bodies.body import Rates
from bhd_lerobot.control.cerebellum import Cerebellum
from bhd_lerobot.control.drive import BaseController
from bhd_lerobot.control.messages import Mode, Reason, Request
from bhd_lerobot.control.record import STATE
from bhd_lerobot.errors import ConfigError, RealtimeError
from bhd_lerobot.realtime import block
from bhd_lerobot.realtime.block import LiveBlock, LiveLayout, Word
from bhd_lerobot.realtime.bridge import LiveBridge
from bhd_lerobot.realtime.requests import RequestServer
from tests.control.support import BODY, PerfectPlant

HZ, FPS = 200, 10
TICK = 1_000_000_000 // HZ
F = HZ // FPS


class Rig:
    """A base's cerebellum behind a block; time goes on when the rig says so."""

    def __init__(self) -> None:
        self.now = 5 * 10**12
        self.cerebellum, mirror = (
            Cerebellum(BODY, PerfectPlant(1), HZ, BaseController(BODY.drive, 1, HZ)) for _ in range(2)
        )
        row = np.dtype([("state", STATE), ("tick", np.int64), ("now_ns", np.int64)])
        layout = LiveLayout(row, 64, 2, 16)
        self.block = layout.create(f"test-bridge-{os.getpid()}", {})
        other = LiveBlock.attach(self.block.name)
        self.other = other
        self.cerebellum.fifo, self.cerebellum.estop = other.fifo, other.estop
        self.server = RequestServer(self.cerebellum, other.requests, other.events)
        self.row = np.zeros(1, row)
        self.start, self.ticks = self.now, 0
        other.words[Word.START] = self.start
        self.bridge = LiveBridge(self.block, mirror, Rates(HZ, HZ, FPS), self.tick, self.clock)

    def clock(self) -> int:
        return self.now

    def tick(self, count: int = 1) -> None:
        """Do what the loop does in some ticks."""
        for _ in range(count):
            self.now = max(self.now, self.start + self.ticks * TICK)
            elapsed = self.ticks * TICK
            self.server.serve(self.now)
            self.cerebellum.tick(elapsed)
            self.row["state"] = self.cerebellum.states
            self.row["tick"], self.row["now_ns"] = self.ticks, elapsed
            self.other.ring.publish(self.row)
            self.ticks += 1

    def close(self) -> None:
        self.block.close()
        self.other.close()


@pytest.fixture
def rig() -> Iterator[Rig]:
    rig = Rig()
    try:
        rig.tick()
        rig.bridge.configure()
        rig.bridge.activate()
        yield rig
    finally:
        rig.close()


def drive(value: float) -> np.ndarray:
    return np.array([[value, 0.0]])


def test_a_reader_of_another_version_is_refused_with_both_versions(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(block, "_VERSION", "9.9.9")
    LiveBlock.watch(rig.block.name).close()  # its record is the same
    monkeypatch.setattr(block, "STATE", np.dtype([("mode", np.int8)]))
    before = len(os.listdir("/proc/self/fd"))
    for opened in (LiveBlock.watch, LiveBlock.attach):
        with pytest.raises(RealtimeError, match=rf"runs version {re.escape(version('lerobot_robot_bhd'))} .* 9\.9\.9"):
            opened(rig.block.name)
    assert len(os.listdir("/proc/self/fd")) == before


def test_invalid_setpoints_are_refused_at_once_with_the_reason(rig: Rig) -> None:
    bridge = rig.bridge

    with pytest.raises(ConfigError, match="number 0"):
        bridge.take_results(1)  # there is one robot

    def reason(values: np.ndarray, due: int | None = None) -> Reason:
        return Reason(int(bridge.send(values, due_ns=due).reasons[0]))

    assert reason(np.zeros((1, 3))) == Reason.WRONG_WIDTH
    assert reason(np.array([["a", "b"]])) == Reason.WRONG_WIDTH
    assert reason(np.array([[np.nan, 0.0]])) == Reason.NON_FINITE
    assert reason(drive(0.1), bridge.now_ns + 10 * TICK) == Reason.ACCEPTED
    assert reason(drive(0.1), bridge.now_ns + 5 * TICK) == Reason.OUT_OF_ORDER
    for _ in range(15):
        assert reason(drive(0.1), bridge.now_ns + 10 * TICK) == Reason.ACCEPTED
    assert reason(drive(0.1), bridge.now_ns + 10 * TICK) == Reason.FIFO_FULL
    bridge.estop()
    assert reason(drive(0.1), bridge.now_ns + 11 * TICK) == Reason.ESTOP


def test_a_command_that_is_refused_leaves_the_order_of_the_next_as_it_was(rig: Rig) -> None:
    bridge = rig.bridge
    absurd = ((2**62, Reason.BEYOND_HORIZON), (2**70, Reason.BEYOND_HORIZON), (-(2**70), Reason.STALE))
    for due, reason in absurd:
        assert bridge.send(drive(0.2), due_ns=due, replaces=True).reasons.tolist() == [reason]
        assert bridge.send(drive(0.1)).accepted.all()
    # Nor does one that was dropped.
    assert bridge.send(drive(0.1), due_ns=bridge.now_ns + 9 * 10**9).accepted.all()
    bridge.deactivate()
    rig.tick(40)
    assert bridge.reset().accepted.all()
    assert bridge.activate().accepted.all()
    assert bridge.send(drive(0.1)).accepted.all()
    rig.tick(40)
    assert bridge.state().command[0, 0] == pytest.approx(0.1)


def test_a_second_bridge_moves_the_robot_and_what_the_first_sends_then_is_dropped_and_counted(rig: Rig) -> None:
    bridge = rig.bridge
    for _ in range(40):
        assert bridge.send(drive(0.1)).accepted.all()
        rig.tick()
    with closing(LiveBlock.attach(rig.block.name)) as block:
        mirror = Cerebellum(BODY, PerfectPlant(1), HZ, BaseController(BODY.drive, 1, HZ))
        second = LiveBridge(block, mirror, bridge.rates, rig.tick, rig.clock)
        for _ in range(5):
            assert second.send(drive(0.05)).accepted.all()
            rig.tick(10)
        assert rig.cerebellum.requested[0, 0] == 0.05
        assert not rig.cerebellum.refusals.any()
        bridge.send(drive(0.2))
        rig.tick(10)
        assert rig.cerebellum.requested[0, 0] == 0.05
        assert rig.cerebellum.refusals[Reason.OUT_OF_ORDER, 0] == 1


def test_a_chunk_takes_effect_frame_by_frame_and_its_end_means_hold(rig: Rig) -> None:
    bridge = rig.bridge
    rows = [0.10, 0.05, 0.15]
    assert all(one.accepted.all() for one in bridge.send_chunk(np.array([drive(row) for row in rows])))
    reached = []
    for number in range(len(rows)):
        rig.tick(F if number else F - 1)  # the chunk was sent at a tick, so that its frames end just before one
        reached.append(float(bridge.state().command[0, 0]))
    # From 0 to 0.1 m/s, to 0.05 and to 0.15 the jerk limit takes longer than a frame.
    assert reached == pytest.approx([0.0748, 0.0719, 0.1133], abs=0.03)
    assert reached[0] < 0.1
    rig.tick(round(BODY.limits.command_timeout_s * HZ))
    assert bridge.state().mode.tolist() in ([Mode.STOPPING], [Mode.HOLD])
    rig.tick(60)
    assert bridge.state().mode.tolist() == [Mode.HOLD]
    assert np.abs(bridge.state().command).max() < 1e-9


def test_a_new_chunk_takes_the_place_of_what_is_left_of_the_last(rig: Rig) -> None:
    bridge = rig.bridge
    bridge.send_chunk(np.array([drive(0.2)] * 10))
    rig.tick(2 * F)
    bridge.send_chunk(np.array([drive(0.05)] * 2))
    rig.tick(2 * F)
    assert bridge.state().command[0, 0] == pytest.approx(0.05)
    assert len(rig.block.fifo) == 0


def test_a_late_brain_neither_jumps_nor_makes_the_robot_hurry(rig: Rig) -> None:
    bridge = rig.bridge
    began = bridge.now_ns  # the observation that the brain looked at
    bridge.send(drive(0.10))
    rig.tick(2 * F + 5)  # it took more than two frames
    rows = [0.22, 0.22, 0.08, 0.12]
    sent = bridge.send_chunk(np.array([drive(row) for row in rows]), start_ns=began)
    assert len(sent) == 2  # the first two were for frames that have gone by
    commands = []
    for _ in range(2 * F):
        rig.tick()
        commands.append(float(bridge.state().command[0, 0]))
    assert max(commands) <= 0.12 + 1e-9
    assert commands[-1] == pytest.approx(0.12)
    change = BODY.limits.acceleration[0] / HZ
    assert np.abs(np.diff([0.10, *commands])).max() <= change + 1e-9


def test_a_reset_acknowledges_only_a_press_that_its_caller_saw_latched(rig):
    rig.bridge.estop()
    assert rig.bridge.estop_pressed
    rig.tick()
    assert rig.cerebellum.mode == Mode.ESTOP
    assert rig.bridge.activate().reasons.tolist() == [Reason.ESTOP]
    server = rig.server.serve

    def meanwhile(now_ns: int) -> None:  # the request is on its way when another process presses, and a tick sees it
        rig.server.serve = server
        rig.other.estop.press()
        rig.cerebellum.tick(now_ns)
        server(now_ns)

    rig.server.serve = meanwhile
    assert rig.bridge.request(Request.RESET).accepted.all()
    assert rig.cerebellum.mode == Mode.ESTOP
    assert rig.bridge.request(Request.RESET).accepted.all()
    assert rig.cerebellum.mode == Mode.INACTIVE
    assert not rig.bridge.estop_pressed
    assert rig.bridge.send(drive(0.1)).reasons.tolist() == [Reason.NOT_ACTIVE]
