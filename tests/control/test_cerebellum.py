"""What holds at every tick, whatever is sent: random histories on a plant with perfect wheels."""

import dataclasses

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from bhd_lerobot.control.cerebellum import Cerebellum
from bhd_lerobot.control.drive import BaseController
from bhd_lerobot.control.fifo import CommandFifo
from bhd_lerobot.control.messages import Limit, Mode, Reason, Request, Setpoint
from bhd_lerobot.errors import ConfigError
from tests.cases import each_case
from tests.control.support import BODY, HZ, TICK_NS, PerfectPlant, Rig

VELOCITY = np.array([0.22, 2.84])
ACCELERATION = np.array([2.5, 3.2])
STOP_DECELERATION = np.array([2.5, 20.0])
WHEEL_SPEED = 2.84 * 0.080 / 0.033

# What a tick may do to the mode; requests are in test_modes.py.
TICK_EDGES = {
    (Mode.HOLD, Mode.TRACKING),
    (Mode.TRACKING, Mode.STOPPING),
    (Mode.STOPPING, Mode.HOLD),
    (Mode.STOPPING, Mode.TRACKING),
    (Mode.STOPPING, Mode.SAFE_OFF),
    *((mode, Mode.ESTOP) for mode in Mode),
    *((mode, Mode.FAULT) for mode in Mode if mode != Mode.ESTOP),
    *((mode, mode) for mode in Mode),
}

VALUE = st.floats(-0.5, 0.5) | st.sampled_from(
    [0.0, 0.22, -0.22, 2.84, -2.84, 1e6, -1e300, 1e308, 5e-324, float("nan"), float("inf"), float("-inf")]
)
SEND = st.tuples(
    st.just("send"),
    st.tuples(VALUE, VALUE),
    st.sampled_from([1, 1, 1, 1, 2, 0, -3]),  # step of the sequence number
    st.sampled_from([0, 0, 0, 0, 1, 7, 40, -50, -99, -150]),  # due, in ticks from now
)
REQUEST = st.tuples(st.just("request"), st.sampled_from(list(Request)))
BREAK = st.tuples(st.just("lie"), st.sampled_from([float("nan"), float("inf"), None, None]))
FAULT = st.tuples(st.just("fault"), st.booleans())
STOP = st.tuples(st.just("estop"))
RECOVER = st.tuples(st.just("recover"))
FLAGS = st.tuples(st.just("flags"))
TICKS = st.tuples(st.just("tick"), st.sampled_from([1, 1, 2, 5, 20, 60, 130]))
STEP = SEND | TICKS | SEND | TICKS | SEND | TICKS | REQUEST | BREAK | FAULT | STOP | RECOVER | RECOVER | FLAGS


def act(rig: Rig, step: tuple, ids: np.ndarray | None = None) -> np.ndarray | None:
    """Do one thing of a history, and return the reasons that came back."""
    who = np.arange(rig.n) if ids is None else ids
    mask = np.isin(np.arange(rig.n), who)
    match step:
        case ("send", values, delta, delay):
            rig.sequence += delta
            rows = np.full((rig.n, 2), np.nan)  # what is not for a simulation must not matter to it
            rows[who] = values
            return rig.cerebellum.offer(Setpoint(rig.sequence, rig.now + delay * TICK_NS, rows), mask).reasons
        case ("request", request):
            return rig.request(request, who).reasons
        case ("lie", value):
            for sim in who:
                rig.plant.lie.pop(int(sim), None)
                if value is not None:
                    rig.plant.lie[int(sim)] = value
        case ("fault", value):
            rig.plant.fault[who] = value
        case ("estop",):
            rig.cerebellum.estop.press(who)
        case ("recover",):
            rig.plant.fault[who] = False
            for sim in who:
                rig.plant.lie.pop(int(sim), None)
            for request in (Request.CONFIGURE, Request.RESET, Request.ACTIVATE):
                rig.request(request, who)
        case ("flags",):
            rig.cerebellum.take_flags()
        case _:
            raise AssertionError(step)
    return None


def between(*twists: tuple[float, float]) -> list[tuple]:
    """Return a history that keeps each twist for a while; forward speed builds up faster than a turn dies down."""
    return [step for twist in twists for _ in range(15) for step in (("send", twist, 1, 0), ("tick", 20))]


@pytest.mark.law
@example(between((0.0, 2.84), (0.22, 0.0)))
@example(between((0.0, 2.84), (-0.22, 0.0)))
@example(between((0.0, 2.84), (0.22, -2.84)))
@settings(max_examples=50)
@given(st.lists(STEP, min_size=1, max_size=30))
def test_every_tick_is_safe(history: list[tuple]) -> None:
    rig = Rig()
    cerebellum = rig.cerebellum
    for step in history:
        if step[0] != "tick":
            act(rig, step)
            continue
        for _ in range(step[1]):
            before, mode_before = cerebellum.command[0].copy(), Mode(int(cerebellum.mode[0]))
            rig.tick()
            command, mode = cerebellum.command[0], Mode(int(cerebellum.mode[0]))
            assert (mode_before, mode) in TICK_EDGES
            assert np.isfinite(command).all()
            assert (np.abs(command) <= VELOCITY).all()
            largest = STOP_DECELERATION if mode in (Mode.ESTOP, Mode.FAULT) else ACCELERATION
            assert (np.abs(command - before) <= largest / HZ + 1e-12).all()
            if mode != Mode.TRACKING:
                assert (np.abs(command) <= np.abs(before)).all()
                assert (command * before >= 0).all()
            if mode in (Mode.HOLD, Mode.SAFE_OFF) and mode_before == mode:
                assert (np.abs(command) < 1e-9).all() or mode == Mode.HOLD
            # The plant asserts that it gets numbers. What it gets are the wheel speeds of the command.
            wheels = rig.plant.written[0]
            expected = (command[0] + np.array([-0.08, 0.08]) * command[1]) / 0.033
            np.testing.assert_allclose(wheels, expected, atol=1e-9)
            assert (np.abs(wheels) <= WHEEL_SPEED * (1 + 1e-9)).all()
    # Left alone, with or without its latches, the robot comes to rest.
    rig.tick(2 * HZ)
    assert cerebellum.command[0].tolist() == [0, 0]
    assert cerebellum.mode[0] not in (Mode.TRACKING, Mode.STOPPING)
    state = cerebellum.state(rig.now)
    assert all(np.isfinite(getattr(state, field.name)).all() for field in dataclasses.fields(state))


def check_answer(rig: Rig, step: tuple, reason: Reason, before: dict, last: tuple[int, int]) -> None:
    """The answer to a setpoint agrees with what the setpoint was and with the mode before it."""
    mode = before["mode"]
    if reason == Reason.ACCEPTED:
        assert mode in (Mode.HOLD, Mode.TRACKING, Mode.STOPPING)
        assert not before["deactivating"]
        assert not before["word"]
        assert np.isfinite(step[1]).all()
        assert rig.sequence > last[0]
        assert before["due"] >= last[1]
    elif reason == Reason.NON_FINITE:
        assert not np.isfinite(step[1]).all()
    elif reason == Reason.OUT_OF_ORDER:
        assert rig.sequence <= last[0] or before["due"] < last[1]
    elif reason == Reason.ESTOP:
        assert mode == Mode.ESTOP or before["word"]
    elif reason == Reason.FAULT:
        assert mode == Mode.FAULT
    else:
        assert reason == Reason.NOT_ACTIVE
        assert before["deactivating"] or mode in (Mode.UNCONFIGURED, Mode.INACTIVE, Mode.SAFE_OFF)


@given(st.lists(STEP, min_size=1, max_size=30))
def test_commands_are_taken_in_the_modes_that_take_them_and_every_refusal_is_counted(history: list[tuple]) -> None:
    rig = Rig()
    cerebellum = rig.cerebellum
    last = -1, -(10**18)  # sequence number and due time of the last command that was accepted
    deactivating = False
    waiting = 0  # commands that were accepted, and neither dropped nor refused since
    for step in history:
        counts = cerebellum.refusals[:, 0].copy()
        before = {
            "mode": Mode(int(cerebellum.mode[0])),
            "word": bool(cerebellum.estop.pressed[0]),
            "deactivating": deactivating,
            "due": rig.now + step[3] * TICK_NS if step[0] == "send" else 0,
        }
        if step[0] == "tick":
            rig.tick(step[1])
        else:
            reasons = act(rig, step)
        change = cerebellum.refusals[:, 0] - counts
        assert (change >= 0).all()
        if step[0] == "tick":
            # In a tick commands are refused that were accepted before: too late, or the mode is another now.
            assert set(np.flatnonzero(change)) <= {Reason.STALE, Reason.NOT_ACTIVE, Reason.ESTOP, Reason.FAULT}
            waiting -= change.sum()
        elif step[0] == "send":
            assert reasons is not None
            reason = Reason(int(reasons[0]))
            check_answer(rig, step, reason, before, last)
            assert change.sum() == change[reason] == (reason != Reason.ACCEPTED)
            if reason == Reason.ACCEPTED:
                last = rig.sequence, before["due"]
                waiting += 1
        elif step[0] == "request":
            assert reasons is not None
            reason = Reason(int(reasons[0]))
            dropped = change[Reason.NOT_ACTIVE] if step == ("request", Request.ACTIVATE) else 0
            waiting -= dropped
            assert change.sum() - dropped == (reason != Reason.ACCEPTED)
            if dropped:  # after an activation a command need not be later than what was dropped
                last = last[0], -(10**18)
            deactivating |= step[1] == Request.DEACTIVATE and reason == Reason.ACCEPTED
        assert waiting >= 0
        deactivating &= cerebellum.mode[0] == Mode.STOPPING


@settings(max_examples=60)
@given(st.lists(st.tuples(st.integers(0, 2), STEP), min_size=1, max_size=40))
def test_simulations_are_independent_byte_for_byte(history: list[tuple[int, tuple]]) -> None:
    """Three at once, each with a history of its own, and the same three one by one."""
    together = Rig(3)
    alone = [Rig() for _ in range(3)]
    sequence = [0, 0, 0]
    for sim, step in history:
        if step[0] == "tick":
            together.tick(step[1])
            for rig in alone:
                rig.tick(step[1])
        elif step[0] == "flags":
            limits, watchdog = together.cerebellum.take_flags()
            each = [rig.cerebellum.take_flags() for rig in alone]
            assert limits.tolist() == [int(flags[0][0]) for flags in each]
            assert watchdog.tolist() == [int(flags[1][0]) for flags in each]
        else:
            together.sequence = sequence[sim]  # each simulation has a sender with numbers of its own
            act(together, step, np.array([sim]))
            sequence[sim] = together.sequence
            act(alone[sim], step)
        state = together.cerebellum.state(together.now)
        for k, rig in enumerate(alone):
            single = rig.cerebellum.state(rig.now)
            for field in dataclasses.fields(state):
                if field.name != "stamp_ns":
                    one, many = getattr(single, field.name)[0], getattr(state, field.name)[k]
                    assert one.tobytes() == many.tobytes(), field.name
            assert rig.plant.written[0].tobytes() == together.plant.written[k].tobytes()
            assert (rig.cerebellum.refusals[:, 0] == together.cerebellum.refusals[:, k]).all()


@each_case(
    "values",
    [
        np.zeros(2),
        np.zeros((1, 3)),
        np.zeros((2, 2)),
        np.zeros((1, 1)),
        np.array([["a", "b"]]),
        np.zeros((1, 2), complex),
    ],
)
def test_a_command_of_another_shape_or_type_is_refused(values: np.ndarray) -> None:
    rig = Rig()
    assert rig.cerebellum.offer(Setpoint(1, 0, values)).reasons.tolist() == [Reason.WRONG_WIDTH]
    assert rig.refused(Reason.WRONG_WIDTH) == 1


def test_a_full_queue_refuses_and_the_sender_can_try_again() -> None:
    rig = Rig(fifo=CommandFifo(1, 2, 4))
    for k in range(4):
        assert rig.send(0.1, due=rig.now + k * TICK_NS).accepted.all()
    assert rig.send(0.1, due=rig.now + 9 * TICK_NS, sequence=5).reasons.tolist() == [Reason.FIFO_FULL]
    rig.tick()
    assert rig.send(0.1, due=rig.now + 9 * TICK_NS, sequence=5).accepted.all()
    assert rig.refused(Reason.FIFO_FULL) == 1


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_non_finite_queue_entries_stop_the_robot(value: float) -> None:
    rig = Rig()
    rig.send(0.2)
    rig.tick(50)
    rig.cerebellum.fifo.push(99, rig.now, np.array([[value, -value]]), np.ones(1, np.bool_))
    rig.tick(50)
    assert rig.command == [0, 0]
    assert rig.cerebellum.take_flags()[0][0] & Limit.NON_FINITE


def test_integer_commands_are_accepted() -> None:
    rig = Rig()
    assert rig.cerebellum.offer(Setpoint(1, 0, np.array([[0, 1]]))).accepted.all()
    rig.tick(95)
    assert rig.command == [0, 1]


def test_a_limit_that_still_holds_is_reported_in_every_frame() -> None:
    rig = Rig()
    for _ in range(20):
        rig.send(1.0)
        rig.tick(20)
        rig.cerebellum.take_flags()
    rig.send(1.0)
    for _ in range(3):  # also in frames without a new command
        rig.tick(20)
        assert Limit(int(rig.cerebellum.take_flags()[0][0])) == Limit.VELOCITY
    rig.send(0.2)
    rig.tick(40)
    rig.cerebellum.take_flags()
    rig.tick(20)
    assert rig.cerebellum.take_flags()[0].tolist() == [Limit.NONE]


def test_a_servo_beyond_its_torque_is_flagged_and_reported_with_its_torque() -> None:
    weak = dataclasses.replace(BODY, drive=dataclasses.replace(BODY.drive, max_torque=0.06))
    plant = PerfectPlant()
    plant.write = lambda ctrl: np.copyto(plant.written, ctrl)  # type: ignore[method-assign]
    cerebellum = Cerebellum(weak, plant, HZ, BaseController(weak.drive, 1, HZ))
    cerebellum.request(Request.CONFIGURE)
    cerebellum.request(Request.ACTIVATE)
    cerebellum.offer(Setpoint(1, 0, np.array([[0.2, 0.0]])))
    for tick in range(100):
        cerebellum.tick(tick * TICK_NS)
        effort = np.clip((plant.written - plant.velocity) * weak.drive.servo_gain, -0.06, 0.06)
        np.testing.assert_allclose(cerebellum.state(0).joint_efforts, effort, atol=1e-12)
    assert cerebellum.take_flags()[0][0] & Limit.EFFORT


def test_wheels_that_are_too_slow_for_the_turning_limit_are_an_error() -> None:
    slow = dataclasses.replace(BODY, drive=dataclasses.replace(BODY.drive, max_wheel_speed=5.0))
    with pytest.raises(ConfigError, match=r"theta.vel is 2.84.*2\.06"):
        BaseController(slow.drive, 1, HZ)


def test_a_state_is_a_copy() -> None:
    rig = Rig()
    rig.send(0.2, 0.3)
    rig.tick(20)
    state = rig.cerebellum.state(rig.now)
    copies = {field.name: np.copy(getattr(state, field.name)) for field in dataclasses.fields(state)}
    rig.cerebellum.estop.press()
    rig.tick(60)
    for name, value in copies.items():
        np.testing.assert_array_equal(getattr(state, name), value)
    state.command[:] = 9.0
    assert rig.command == [0, 0]


def test_a_controller_gets_all_sensors_that_it_takes() -> None:
    controller = BaseController(BODY.drive, 1, HZ, gyro=3)
    for sensors in (0, 3):
        with pytest.raises(ConfigError, match=f"takes 4 sensors; the plant reads {sensors}"):
            Cerebellum(BODY, PerfectPlant(), HZ, controller, sensors=sensors)
