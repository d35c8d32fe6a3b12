"""The mode machine, edge by edge, on a virtual clock."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bhd_lerobot.control.messages import Limit, Mode, Reason, Request, Watchdog
from bhd_lerobot.control.record import command_age_ns
from tests.cases import each_case
from tests.control import support
from tests.control.support import HZ, TICK_NS, Rig

TIMEOUT_TICKS = HZ // 2


def in_mode(mode: Mode) -> Rig:
    """Return a rig that got into a mode by the front door."""
    rig = Rig(active=False)
    if mode == Mode.UNCONFIGURED:
        return rig
    rig.request(Request.CONFIGURE)
    if mode == Mode.INACTIVE:
        return rig
    rig.request(Request.ACTIVATE)
    if mode == Mode.HOLD:
        return rig
    rig.send(0.2, 0.5)
    rig.tick(20)
    if mode == Mode.STOPPING:
        rig.request(Request.DEACTIVATE)
    elif mode == Mode.SAFE_OFF:
        rig.request(Request.DEACTIVATE)
        rig.tick(100)
    elif mode == Mode.ESTOP:
        rig.cerebellum.estop.press()
        rig.tick(60)  # to rest
    elif mode == Mode.FAULT:
        rig.plant.fault[0] = True
        rig.tick(60)
        rig.plant.fault[0] = False
    assert rig.mode == mode
    return rig


REQUESTS = {
    (Mode.UNCONFIGURED, Request.CONFIGURE): Mode.INACTIVE,
    (Mode.INACTIVE, Request.ACTIVATE): Mode.HOLD,
    (Mode.HOLD, Request.DEACTIVATE): Mode.STOPPING,
    (Mode.TRACKING, Request.DEACTIVATE): Mode.STOPPING,
    (Mode.STOPPING, Request.DEACTIVATE): Mode.STOPPING,
    (Mode.ESTOP, Request.RESET): Mode.INACTIVE,
    (Mode.FAULT, Request.RESET): Mode.INACTIVE,
    (Mode.SAFE_OFF, Request.RESET): Mode.INACTIVE,
}


@pytest.mark.law
@pytest.mark.parametrize("mode", list(Mode), ids=lambda mode: mode.name)
def test_every_request_in_every_mode(mode: Mode) -> None:
    for request in Request:
        rig = in_mode(mode)
        before = rig.cerebellum.refusals.sum()
        result = rig.request(request)
        if (mode, request) in REQUESTS:
            assert result.accepted.all()
            assert rig.mode == REQUESTS[mode, request]
            assert rig.cerebellum.refusals.sum() == before
        else:
            expected = {Mode.ESTOP: Reason.ESTOP, Mode.FAULT: Reason.FAULT}.get(mode, Reason.WRONG_MODE)
            assert result.reasons.tolist() == [expected]
            assert rig.mode == mode
            assert rig.cerebellum.refusals.sum() == before + 1


@each_case("mode", list(Mode))
def test_a_setpoint_in_every_mode(mode: Mode) -> None:
    rig = in_mode(mode)
    before = rig.cerebellum.refusals.copy()
    result = rig.send(0.1, 0.1)
    refusal = {
        Mode.HOLD: None,
        Mode.TRACKING: None,
        Mode.ESTOP: Reason.ESTOP,
        Mode.FAULT: Reason.FAULT,
    }.get(mode, Reason.NOT_ACTIVE)  # STOPPING is that of a deactivation here
    rig.tick()
    if refusal is None:
        assert result.accepted.all()
        assert rig.mode == Mode.TRACKING
        assert (rig.cerebellum.refusals == before).all()
    else:
        assert result.reasons.tolist() == [refusal]
        assert rig.mode != Mode.TRACKING
        assert rig.refused(refusal) == before[refusal, 0] + 1


@each_case("mode", list(Mode))
def test_an_emergency_stop_in_every_mode(mode: Mode) -> None:
    rig = in_mode(mode)
    rig.cerebellum.estop.press()
    rig.tick()
    assert rig.mode == Mode.ESTOP
    assert rig.cerebellum.state(rig.now).emergency_stop.all()
    rig.tick(1000)
    assert rig.mode == Mode.ESTOP


@each_case("mode", list(Mode))
def test_a_plant_fault_in_every_mode(mode: Mode) -> None:
    rig = in_mode(mode)
    rig.plant.fault[0] = True
    rig.tick(60)
    # An emergency stop is not replaced by a fault; the fault shows after its reset.
    assert rig.mode == (Mode.ESTOP if mode == Mode.ESTOP else Mode.FAULT)
    if mode == Mode.ESTOP:
        assert rig.request(Request.RESET).accepted.all()
        rig.tick()
        assert rig.mode == Mode.FAULT
    rig.request(Request.RESET)
    rig.tick()
    assert rig.mode == Mode.FAULT  # the cause is still there
    rig.plant.fault[0] = False
    rig.request(Request.RESET)
    rig.tick()
    assert rig.mode == Mode.INACTIVE


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_readings_that_are_no_numbers_are_a_fault_and_do_not_spread(value: float) -> None:
    rig = in_mode(Mode.TRACKING)
    original = rig.plant.read

    def read(out: Any) -> None:
        original(out)
        out.position[0], out.velocity[0, 1] = (value, -value), value

    rig.plant.read = read  # type: ignore[method-assign]
    rig.tick()
    assert rig.mode == Mode.FAULT
    rig.tick(200)
    state = rig.cerebellum.state(rig.now)
    for field in (state.joint_positions, state.joint_velocities, state.joint_efforts, state.odometry, state.measured):
        assert np.isfinite(field).all()
    assert rig.command == [0, 0]


def test_configuring_on_a_broken_plant_is_refused() -> None:
    rig = Rig(active=False)
    rig.plant.lie[0] = np.nan
    assert rig.request(Request.CONFIGURE).reasons.tolist() == [Reason.FAULT]
    assert rig.mode == Mode.FAULT
    rig.plant.lie.clear()
    rig.tick(5)
    assert np.isfinite(rig.cerebellum.state(rig.now).odometry).all()


def test_a_command_that_grows_old_ramps_to_zero_and_motion_resumes_with_the_next() -> None:
    rig = Rig()
    rig.send(0.1, 1.0)
    rig.tick(TIMEOUT_TICKS + 1)  # the last of these ticks is 0.5 s after the command: not yet older
    assert rig.mode == Mode.TRACKING
    assert rig.command == [0.1, 1.0]
    assert rig.cerebellum.take_flags()[1].tolist() == [Watchdog.NONE]
    assert command_age_ns(rig.cerebellum.states, rig.now - TICK_NS).tolist() == [500_000_000]
    rig.tick()
    assert rig.mode == Mode.STOPPING
    assert rig.cerebellum.take_flags()[1].tolist() == [Watchdog.COMMAND_AGE]
    commands = []
    while rig.mode == Mode.STOPPING:
        commands.append(rig.command)
        rig.tick()
    ramp = np.array([[0.1, 1.0], *commands])
    assert rig.mode == Mode.HOLD
    assert rig.command == [0, 0]
    assert (np.diff(ramp, axis=0) <= 0).all()
    assert (np.diff(ramp, axis=0) >= -np.array([2.5, 3.2]) / HZ - 1e-12).all()
    changes = np.diff(np.concatenate([ramp[:1], ramp, ramp[-1:]]), axis=0)
    assert (np.abs(np.diff(changes, axis=0)) <= 7 * np.array([2.5, 3.2]) / HZ**2 + 1e-12).all()
    # No longer than the normal limits take: 1.0 rad/s at 3.2 rad/s^2, which takes a seventh of a second to build up.
    assert len(commands) == pytest.approx(HZ * (1 / 3.2 + 1 / 7), abs=3)
    assert rig.cerebellum.take_flags()[1].tolist() == [Watchdog.NONE]
    rig.tick(1000)
    assert rig.mode == Mode.HOLD
    assert rig.send(0.1).accepted.all()
    rig.tick(40)
    assert rig.mode == Mode.TRACKING
    assert rig.command == [0.1, 0.0]


def test_a_new_command_while_the_robot_stops_takes_over_without_a_jump() -> None:
    rig = Rig()
    rig.send(0.2)
    rig.tick(TIMEOUT_TICKS + 5)
    assert rig.mode == Mode.STOPPING
    seen = [rig.command[0]]
    assert 0 < seen[0] < 0.2
    for _ in range(40):
        rig.send(0.2)
        rig.tick()
        seen.append(rig.command[0])
        assert rig.mode == Mode.TRACKING
    assert seen[-1] == 0.2
    assert np.abs(np.diff(seen, 2)).max() <= 7 * 2.5 / HZ**2 + 1e-12


def test_a_command_that_is_late_on_arrival_is_refused_as_stale() -> None:
    rig = Rig()
    rig.tick(200)
    assert rig.send(0.2, due=rig.now - 500_000_001).accepted.all()  # it goes into the queue,
    rig.tick()
    assert rig.refused(Reason.STALE) == 1  # and is refused when it comes out of it
    assert rig.mode == Mode.HOLD
    assert rig.send(0.2, due=rig.now - 400_000_000).accepted.all()
    rig.tick()
    assert rig.mode == Mode.TRACKING
    rig.tick(25)
    assert rig.mode == Mode.STOPPING  # 0.5 s after it was due, not after it came


def test_a_command_takes_effect_when_it_is_due() -> None:
    rig = Rig()
    rig.send(0.1, due=rig.now + 10 * TICK_NS)
    rig.send(0.2, due=rig.now + 50 * TICK_NS)
    rig.tick(10)
    assert rig.mode == Mode.HOLD
    rig.tick(30)
    assert rig.command[0] == 0.1
    rig.tick(11)
    assert rig.command[0] > 0.1


@pytest.mark.parametrize("mode", [Mode.ESTOP, Mode.FAULT, Mode.SAFE_OFF], ids=lambda mode: mode.name)
def test_after_a_latch_a_reset_moves_nothing_and_the_deactivation_is_over(mode: Mode) -> None:
    rig = in_mode(mode)
    assert rig.request(Request.RESET).accepted.all()
    rig.tick(100)
    assert rig.mode == Mode.INACTIVE
    assert not rig.cerebellum.state(rig.now).emergency_stop.any()
    assert rig.command == [0, 0]
    assert rig.request(Request.ACTIVATE).accepted.all()
    assert rig.send(0.2).accepted.all()
    rig.tick(10)
    assert rig.mode == Mode.TRACKING
    # It stops to HOLD, not to SAFE_OFF.
    rig.tick(TIMEOUT_TICKS + 50)
    assert rig.mode == Mode.HOLD


STOPS: dict[str, Callable[[Rig], object]] = {
    "word": lambda rig: rig.cerebellum.estop.press(),
    "fault": lambda rig: rig.plant.fault.fill(True),
    "deactivation": lambda rig: rig.request(Request.DEACTIVATE),
}


@each_case("stop", STOPS)
def test_commands_from_before_a_stop_never_start_motion_after_it(stop: str) -> None:
    """The rest of an action chunk waits in the queue when the robot is stopped."""
    rig = Rig()
    for k in range(9):
        assert rig.send(0.2, due=rig.now + k * 20 * TICK_NS).accepted.all()
    assert rig.send(0.2, due=rig.now + 1000 * TICK_NS).accepted.all()
    rig.tick(21)
    STOPS[stop](rig)
    rig.tick(70)
    rig.plant.fault[0] = False
    assert rig.request(Request.RESET).accepted.all()
    assert rig.request(Request.ACTIVATE).accepted.all()
    rig.tick(200)
    assert rig.mode == Mode.HOLD
    assert rig.command == [0, 0]
    assert rig.cerebellum.refusals.sum() == 8  # ten, less the two that were followed
    assert rig.send(0.1).accepted.all()  # now, although the chunk's last due time was later than that
    rig.tick(30)
    assert rig.command[0] == 0.1


def test_a_reset_waits_until_the_stop_is_over() -> None:
    rig = in_mode(Mode.TRACKING)
    rig.cerebellum.estop.press()
    rig.tick(3)
    assert rig.command[0] > 0
    assert rig.request(Request.RESET).reasons.tolist() == [Reason.NOT_AT_REST]
    assert rig.mode == Mode.ESTOP
    before = rig.command[0]
    rig.tick()
    assert before - rig.command[0] == pytest.approx(2.5 / HZ)  # it goes on stopping as hard as before
    rig.tick(60)
    assert rig.request(Request.RESET).accepted.all()


@pytest.mark.parametrize("request_", [Request.RESET, Request.ACTIVATE])
def test_a_robot_that_presses_is_neither_reset_nor_activated_and_the_force_is_published(request_: Request) -> None:
    rig = Rig(2)
    rig.cerebellum.estop.press()
    rig.tick(100)
    if request_ == Request.ACTIVATE:
        assert rig.request(Request.RESET).accepted.all()
    before, force = rig.mode, rig.cerebellum.states["pressed"]
    force[0] = 80.0
    assert rig.request(request_).reasons.tolist() == [Reason.PRESSED, Reason.ACCEPTED]
    assert rig.mode == before
    assert rig.cerebellum.estop.pressed[0] or request_ == Request.ACTIVATE  # nothing was acknowledged
    assert rig.cerebellum.state(rig.now).pressed.tolist() == [80.0, 0.0]
    force[0] = 0.0
    assert rig.request(request_, np.array([0])).accepted.all()
    force[0] = 80.0
    assert rig.request(Request.CONFIGURE).reasons[0] == Reason.WRONG_MODE  # asked for what does not apply


def test_a_stop_before_the_configuration_leaves_odometry_at_zero() -> None:
    rig = Rig(active=False)
    rig.plant.position[:] = 12.5
    rig.cerebellum.estop.press()
    rig.tick()
    assert rig.request(Request.RESET).accepted.all()
    assert rig.request(Request.ACTIVATE).accepted.all()
    rig.tick()
    assert rig.cerebellum.state(rig.now).odometry[0].tolist() == [0, 0, 0]


@pytest.mark.law
@given(
    st.sampled_from([Mode.TRACKING, Mode.FAULT, Mode.SAFE_OFF]),
    st.lists(st.sampled_from(["press", "tick", "reset", "activate", "send"]), min_size=1, max_size=40),
)
def test_no_press_is_lost_however_presses_and_resets_meet(mode: Mode, history: list[str]) -> None:
    """A press that no tick has seen yet is never acknowledged: the next tick latches it, whatever came first."""
    rig = in_mode(mode)
    unseen = False
    for what in history:
        if what == "press":
            rig.cerebellum.estop.press()
            unseen = True
        elif what == "tick":
            rig.tick()
            assert not unseen or rig.mode == Mode.ESTOP
            unseen = False
        elif what == "send":
            taken = rig.send(0.2).accepted[0]
            assert not (taken and unseen)
        else:
            rig.request(Request.RESET if what == "reset" else Request.ACTIVATE)


def test_a_press_in_the_middle_of_a_reset_is_not_lost() -> None:
    rig = in_mode(Mode.ESTOP)
    word = rig.cerebellum.estop
    acknowledge = word.acknowledge

    def meanwhile(mask: np.ndarray, press: int | None) -> None:
        word.press()  # before the store of the acknowledgement
        acknowledge(mask, press)

    word.acknowledge = meanwhile  # type: ignore[method-assign]
    assert rig.request(Request.RESET).accepted.all()
    assert rig.request(Request.ACTIVATE).accepted.all()
    assert rig.send(0.2).reasons.tolist() == [Reason.ESTOP]
    rig.tick()
    assert rig.mode == Mode.ESTOP


def test_one_of_two_robots_can_be_stopped() -> None:
    rig = Rig(2)
    rig.send(0.2)
    rig.tick(20)
    assert (rig.cerebellum.mode == Mode.TRACKING).all()
    rig.cerebellum.estop.press(np.array([1]))
    rig.send(0.2)
    rig.tick()
    assert rig.cerebellum.mode.tolist() == [Mode.TRACKING, Mode.ESTOP]
    assert rig.cerebellum.refusals[Reason.ESTOP].tolist() == [0, 1]
    rig.tick(40)
    assert rig.cerebellum.command[:, 0].tolist() == [0.2, 0]


def test_a_restart_forgets_the_episode_before_in_the_simulations_named_only() -> None:
    rig = Rig(2)
    rig.send(0.2, 0.5)
    rig.send(0.1, due=rig.now + 500 * TICK_NS)
    rig.tick(20)
    rig.cerebellum.estop.press()
    rig.tick()
    rig.send(0.2)
    before = rig.cerebellum.command[1].tobytes()
    rig.cerebellum.restart(np.array([0]))
    state = rig.cerebellum.state(rig.now)
    assert state.mode.tolist() == [Mode.UNCONFIGURED, Mode.ESTOP]
    assert state.emergency_stop.tolist() == [False, True]
    assert state.command[0].tolist() == [0, 0]
    assert state.joint_efforts[0].tolist() == (-state.joint_velocities[0] * support.BODY.drive.servo_gain).tolist()
    assert rig.cerebellum.command[1].tobytes() == before
    assert rig.cerebellum.refusals.sum(axis=0).tolist() == [0, 1]
    assert rig.cerebellum.estop.pressed.tolist() == [False, True]
    rig.tick(50)
    assert rig.cerebellum.mode[0] == Mode.UNCONFIGURED
    assert rig.plant.written[0].tolist() == [0, 0]  # it does not move before it is configured
    ids = np.array([0])
    rig.request(Request.CONFIGURE, ids)
    rig.request(Request.ACTIVATE, ids)
    assert rig.cerebellum.state(rig.now).odometry[0].tolist() == [0, 0, 0]
    assert rig.cerebellum.take_flags()[0].tolist()[0] == Limit.NONE
    assert rig.send(0.1, sequence=0).reasons.tolist() == [Reason.ACCEPTED, Reason.ESTOP]
    rig.tick(600)
    assert rig.cerebellum.mode.tolist() == [Mode.HOLD, Mode.ESTOP]
    assert rig.cerebellum.refusals[:, 0].sum() == 0


def test_recorded_enum_values_are_stable() -> None:
    """Datasets hold these numbers: a change breaks what was recorded before."""
    assert [mode.name for mode in Mode] == [
        "UNCONFIGURED", "INACTIVE", "HOLD", "TRACKING", "STOPPING", "SAFE_OFF", "ESTOP", "FAULT",
    ]  # fmt: skip
    assert [int(mode) for mode in Mode] == list(range(8))
    assert {flag.name: int(flag) for flag in Limit} == {
        "NON_FINITE": 1, "VELOCITY": 2, "ACCELERATION": 4, "EFFORT": 8, "POSITION": 16, "POSTURE": 32,
        "CLEARANCE": 64,
    }  # fmt: skip
    assert {flag.name: int(flag) for flag in Watchdog} == {
        "COMMAND_AGE": 1, "BLOCKED": 2, "BRAIN": 4, "RECORDER": 8, "PLANT": 16, "MISSES": 32, "GUARD": 64,
        "FORCE": 128, "SPEED": 256,
    }  # fmt: skip
