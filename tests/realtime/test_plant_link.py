"""A cerebellum and a plant in two processes: the plant judges commands by their age, and stops are latched."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bhd_lerobot.bodies.ur5 import ur5
from bhd_lerobot.control.guard import Guard, WireLimits
from bhd_lerobot.control.messages import Mode
from bhd_lerobot.control.plant import PlantReading, SafetyStatus
from bhd_lerobot.realtime.plant_link import CommandGuard, PlantLink, PlantPhase, PlantShape, RemotePlant

SHAPE = PlantShape(joints=2, positions=9, velocities=8, features=300, touches=1, sensors=3, capacity=4)
MS = 1_000_000
TIMEOUT = 20 * MS


def anything() -> Guard:
    """Return a guard that lets all finite commands through."""
    far = np.full(2, 1e9)
    return Guard(WireLimits(-far, far, far, far, np.full(2, np.nan)), 1)


class Rig:
    """Both ends of a link in one process, on a virtual clock."""

    def __init__(self, timeout_ns: int = TIMEOUT) -> None:
        self.now = 1000 * MS
        self.link = PlantLink(SHAPE)
        self.remote = RemotePlant(self.link, lambda: self.now)
        self.guard = CommandGuard(self.link, timeout_ns, anything(), MS)
        self.guard.begin()

    def send(self, value: float = 1.0) -> None:
        self.remote.write(np.full((1, 2), value))

    def check(self, after_ms: float = 0.0) -> PlantPhase:
        self.now += round(after_ms * MS)
        return self.guard.check(self.now, np.zeros((1, 2)))

    def publish_state(self) -> PlantReading:
        """Publish the state of the guard, and return the cerebellum's reading of it."""
        state = np.zeros((), SHAPE.state_dtype)
        state["stops"], state["position"], state["velocity"] = self.guard.stops, (1.0, 2.0), (3.0, 4.0)
        self.link.states.publish(state)
        reading = PlantReading(1, 2, 3)
        self.remote.read(reading)
        return reading

    def stop(self) -> None:
        self.send()
        self.check()
        assert self.check(21) == PlantPhase.STOPPED


def test_a_plant_waits_until_it_is_commanded_in_this_segment_and_gets_the_mode_with_the_commands() -> None:
    rig = Rig()
    assert [rig.check(5) for _ in range(10)] == [PlantPhase.WAITING] * 10
    rig.send()
    for mode in (Mode.TRACKING, Mode.FAULT):
        rig.now += 5000 * MS  # a pause is no absence
        rig.guard.begin()
        assert rig.check(1) == PlantPhase.WAITING
        rig.remote.set_mode(np.array([mode], np.int8))
        rig.send(3.0)
        assert rig.check(1) == PlantPhase.DRIVEN
        assert rig.guard.actuators.tolist() == [[3.0, 3.0]]
        assert rig.guard.mode.tolist() == [mode]
    assert rig.guard.stops == 0


@given(
    period=st.integers(1, 9),
    phase=st.floats(0.0, 1.0, exclude_max=True),
    ticks=st.integers(1, 50),
)
def test_silence_stops_the_plant_within_its_time_out_and_a_tick(period: int, phase: float, ticks: int) -> None:
    rig = Rig()
    for _ in range(ticks):
        rig.send()
        assert rig.check(phase * period) == PlantPhase.DRIVEN
        rig.now += round((1 - phase) * period * MS)
    last = rig.guard.stamp_ns
    rig.now -= round((1 - phase) * period * MS)
    while rig.check(period) == PlantPhase.DRIVEN:
        assert rig.now - last <= TIMEOUT
    assert rig.guard.stopped_ns == rig.now
    assert TIMEOUT < rig.now - last <= TIMEOUT + period * MS
    assert rig.guard.stops == 1


@pytest.mark.law
def test_a_stop_is_latched_until_a_fresh_command_acknowledges_it() -> None:
    rig = Rig()
    rig.stop()
    for _ in range(5):
        rig.send()
        assert rig.check(1) == PlantPhase.STOPPED
    assert rig.publish_state().safety.tolist() == [SafetyStatus.STOPPED]
    rig.remote.recover()
    assert rig.publish_state().safety.tolist() == [SafetyStatus.NORMAL]
    assert rig.check(1) == PlantPhase.STOPPED  # the commands so far acknowledge nothing
    rig.send()
    assert rig.check(21) == PlantPhase.STOPPED  # nor do old ones
    rig.send()
    assert rig.check(1) == PlantPhase.DRIVEN
    assert rig.guard.stops == 1


def test_a_command_from_the_future_drives_nothing_and_never_grows_fresh() -> None:
    rig = Rig()
    rig.send()
    assert rig.check(1) == PlantPhase.DRIVEN
    rig.now += 10_000 * MS
    rig.send()  # stamped by a clock that is ahead
    rig.now -= 10_000 * MS
    assert rig.check(1) == PlantPhase.STOPPED
    assert rig.check(TIMEOUT / MS) == PlantPhase.STOPPED


def test_an_acknowledgement_is_for_the_stops_that_were_seen() -> None:
    rig = Rig()
    rig.publish_state()
    rig.remote.recover()  # of none
    rig.stop()
    rig.send()
    assert rig.check(1) == PlantPhase.STOPPED


def test_a_stop_outlasts_a_pause_and_ends_with_a_new_scene() -> None:
    rig = Rig()
    rig.stop()
    rig.guard.begin()
    rig.send()
    assert rig.check(1) == PlantPhase.STOPPED
    rig.guard.place()
    assert rig.check(1) == PlantPhase.WAITING
    rig.send()
    assert rig.check(1) == PlantPhase.DRIVEN


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_command_that_is_no_number_stops_the_plant(bad: float) -> None:
    rig = Rig()
    rig.send(2.0)
    rig.check()
    rig.send(bad)
    assert rig.check(1) == PlantPhase.STOPPED
    assert rig.guard.actuators.tolist() == [[2.0, 2.0]]


def test_a_plant_that_was_away_itself_stops_although_commands_are_fresh() -> None:
    rig = Rig()
    rig.send()
    rig.check()
    rig.now += 21 * MS
    rig.send()
    assert rig.check() == PlantPhase.STOPPED


def test_the_newest_plant_state_is_read_and_a_silent_plant_is_a_fault() -> None:
    rig = Rig()
    reading = PlantReading(1, 2, 3)
    rig.remote.read(reading)
    assert reading.safety.tolist() == [SafetyStatus.STOPPED]
    rig.remote.recover()  # of nothing: refused without an error
    reading = rig.publish_state()
    assert (reading.position.tolist(), reading.velocity.tolist()) == ([[1.0, 2.0]], [[3.0, 4.0]])
    assert reading.safety.tolist() == [SafetyStatus.NORMAL]


def test_reading_and_writing_never_wait_for_the_other_side() -> None:
    """Ten times as many entries as there are slots, without a reader; then the newest is there."""
    rig = Rig()
    for number in range(80):
        rig.send(float(number))
        rig.publish_state()
    assert rig.check() == PlantPhase.DRIVEN
    assert rig.guard.actuators.tolist() == [[79.0, 79.0]]
    assert rig.guard.number == 80


@pytest.mark.thorough(but=1)
@pytest.mark.parametrize("misses", [0.3, 0.1, 0.02])
def test_a_plant_that_misses_commands_makes_them_up_gradually(misses: float) -> None:
    """An arm that sways near its largest speed; the plant does not look in some of the ticks."""
    arm, period = ur5(), 2 * MS
    limits = WireLimits.of(arm, 500)
    for seed in range(3):
        rng = np.random.default_rng(seed)
        link, clock = PlantLink(replace(SHAPE, joints=7)), [1000 * MS]
        remote = RemotePlant(link, lambda clock=clock: clock[0])  # type: ignore[misc]
        guard = CommandGuard(link, 10 * TIMEOUT, Guard(limits, 1), period)
        guard.begin()
        where, written = np.array(arm.arm.home)[None], []
        for tick in range(1200):
            command = np.array(arm.arm.home)
            command[:6] += np.array([1, 0.5, -0.7, 1, 1, -1]) * (1 - np.cos(3.0 * min(tick, 1047) / 500))
            remote.write(command[None])
            clock[0] += period
            if rng.random() > misses:
                assert guard.check(clock[0], where) == PlantPhase.DRIVEN
                where = guard.actuators.copy()
                written.append(where[0])
        change = np.diff(np.array(written), axis=0)
        assert (np.abs(change) <= limits.change + 1e-12).all()
        assert (np.abs(np.diff(change, axis=0)) <= limits.bend + 1e-12).all()
        np.testing.assert_array_equal(written[-1], command)
