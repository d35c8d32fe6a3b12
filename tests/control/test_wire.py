"""What is written to the plant is safe, whatever is sent, and whatever breaks between the brain and the wire.

The limits are stated here anew, from the body's numbers: nothing in this file asks the guard what it thinks.
"""

from collections.abc import Callable
from itertools import count
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Rates
from bhd_lerobot.control import kernels
from bhd_lerobot.control import tick as tick_module
from bhd_lerobot.control.bridge import LockstepBridge
from bhd_lerobot.control.cerebellum import Cerebellum
from bhd_lerobot.control.commands import ResultCode
from bhd_lerobot.control.drive import BaseController, twist_from_wheels
from bhd_lerobot.control.messages import HORIZON_NS, Mode, Reason, Request, Setpoint, Watchdog
from bhd_lerobot.control.motion.planner import GoalPlanner
from bhd_lerobot.control.record import NEVER
from bhd_lerobot.realtime.planning_link import PlanningLink, PlanServer
from tests.control import arm_rig, support
from tests.control.arm.test_impedance import ARM as TORQUE_ARM
from tests.control.arm.test_impedance import StuckRig

Array = NDArray[np.float64]

WHEEL = support.BODY.drive
TWIST, TWIST_CHANGE = np.array([0.22, 2.84]), np.array([2.5, 20.0]) / support.HZ
WHEEL_CHANGE = (2.5 + 20.0 * WHEEL.wheel_separation / 2) / WHEEL.wheel_radius / support.HZ
ARM = arm_rig.ARM
SERVO_CHANGE = (np.array(ARM.limits.velocity) + 2 * arm_rig.LEAD * arm_rig.STOP) / arm_rig.HZ
EFFORT = np.array(TORQUE_ARM.limits.effort[:6])


class Wire:
    """A plant that asserts that what is written to it is safe, and remembers it."""

    def __init__(self, plant: Any, lower: Any, upper: Any, change: Any) -> None:
        self._plant, self.n = plant, plant.n
        self._lower, self._upper, self._change = (np.asarray(value) for value in (lower, upper, change))
        self.last: Array | None = None
        self.count = 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._plant, name)

    def write(self, ctrl: Array) -> None:
        assert np.isfinite(ctrl).all()
        assert (ctrl >= self._lower - 1e-3).all()
        assert (ctrl <= self._upper + 1e-3).all()
        if self.last is not None:
            assert (np.abs(ctrl - self.last) <= self._change * 1.021 + 1e-12).all(), (ctrl - self.last).tolist()
        self.last = ctrl.copy()
        self.count += 1
        self._plant.write(ctrl)


def base_rig(n: int = 1) -> support.Rig:
    rig = support.Rig(n)
    most = WHEEL.max_wheel_speed
    rig.plant = rig.cerebellum.plant = Wire(rig.plant, [-most] * 2, [most] * 2, WHEEL_CHANGE)  # type: ignore[assignment]
    return rig


def twist_rig(n: int = 1) -> support.Rig:
    rig = support.Rig(n, takes="twist")
    rig.plant = rig.cerebellum.plant = Wire(rig.plant, -TWIST, TWIST, TWIST_CHANGE)  # type: ignore[assignment]
    return rig


def arm(n: int = 1, planning: Any = None) -> arm_rig.Rig:
    rig = arm_rig.Rig(n, planning=planning)
    lower, upper = ARM.limits.lower, ARM.limits.upper
    rig.plant = rig.cerebellum.plant = Wire(rig.plant, lower, upper, SERVO_CHANGE)  # type: ignore[assignment]
    return rig


def torque_arm() -> StuckRig:
    rig = StuckRig()
    limits = TORQUE_ARM.limits
    change = [*(EFFORT / 0.1 / 500), limits.velocity[-1] / 500]
    lower, upper = [*-EFFORT, limits.lower[-1]], [*EFFORT, limits.upper[-1]]
    rig.plant = rig.cerebellum.plant = Wire(rig.plant, lower, upper, change)  # type: ignore[assignment]
    return rig


def planned_arm() -> tuple[arm_rig.Rig, PlanningLink, PlanServer]:
    """Return an arm in the middle of a motion that another process planned."""
    block = bytearray(PlanningLink.nbytes(6, 7, arm_rig.HZ))
    link, server = PlanningLink(block, 6, 7, arm_rig.HZ), PlanServer(block, GoalPlanner(ARM, arm_rig.HZ))
    rig = arm(planning=link)
    assert rig.go(joint_target=arm_rig.posture(j0=1.5)) is None
    for _ in range(220):
        rig.tick()
        server.serve_once()
    return rig, link, server


BREAK: dict[str, Callable[[Array], None]] = {
    "not a number": lambda values: values.fill(np.nan),
    "one infinity": lambda values: values.__setitem__((..., 0), np.inf),
    "a jump of 1 rad": lambda values: values.__iadd__(1.0),
    "the other sign": lambda values: values.__imul__(-1.0),
    "far away": lambda values: values.fill(1e300),
}


@pytest.mark.parametrize("how", BREAK)
def test_rows_in_shared_memory_that_were_overwritten_stop_the_arm_and_move_nothing(how: str) -> None:
    rig, link, server = planned_arm()
    assert rig.mode == Mode.TRACKING
    assert np.abs(rig.cerebellum.reading.velocity).max() > 0.5  # under way
    where = rig.plant.position.copy()
    BREAK[how](link._memory.rows)
    rig.tick()
    assert rig.mode == Mode.FAULT
    assert rig.cerebellum.take_flags()[1].tolist() == [Watchdog.GUARD]
    assert rig.results() == [("1", ResultCode.FAULT)]
    rig.tick(500)
    # It has braked as in any other hard stop: no farther than from this speed with the limits of a stop.
    speed = np.array(ARM.limits.velocity)
    room = speed**2 / (2 * arm_rig.STOP) + speed * arm_rig.STOP / np.array(ARM.limits.stop_jerk)
    assert (np.abs(rig.plant.position - where)[0] <= room + 0.02).all()
    assert np.abs(rig.plant.velocity).max() < 1e-6
    # and nothing is left of it afterwards
    assert rig.request(Request.RESET).accepted.all()
    assert rig.request(Request.ACTIVATE).accepted.all()
    assert rig.go(joint_target=arm_rig.posture(j0=0.2)) is None
    for _ in range(1500):
        rig.tick()
        server.serve_once()
    assert rig.results() == [("2", ResultCode.SUCCEEDED)]


@pytest.mark.parametrize("how", BREAK)
@pytest.mark.parametrize("what", ["command", "actuators"])
def test_numbers_of_the_controller_that_are_wrong_do_not_reach_the_wire(how: str, what: str) -> None:
    rigs: dict[str, Any] = {"base": base_rig(2), "twist": twist_rig(2), "arm": arm(2), "torques": torque_arm()}
    for name, rig in rigs.items():
        for step in range(10 if name == "torques" else 30):
            if name in ("base", "twist"):
                rig.send(0.2, 0.5)
                rig.tick(4)
            elif name == "arm":
                rig.send(arm_rig.off(j0=0.02 * step))
                rig.tick(arm_rig.FRAME)
            else:
                rig.target[0, 2] += 1e-3
                rig.send()
        assert rig.mode == Mode.TRACKING
        controller = rig.cerebellum.controller
        with (
            pytest.MonkeyPatch.context() as patch,
            kernels.plain_python(),
            np.errstate(invalid="ignore"),  # infinity less infinity
        ):
            kernel = {"base": "drive", "twist": "drive", "arm": "move_arm", "torques": "move_spring"}[name]
            run, calls = getattr(tick_module, kernel), count()

            def broken(*arguments: Any, run: Any = run, controller: Any = controller, calls: Any = calls) -> Any:
                result = run(*arguments)
                if next(calls) % 2 == 0 or len(controller.states) == 1:  # robots are ticked one by one: the first
                    BREAK[how](getattr(controller, what)[:1])
                return result

            patch.setattr(tick_module, kernel, broken)
            for _ in range(20):
                rig.tick()
        if rig.mode == Mode.TRACKING:
            # It did not get as far as the actuators: the command is computed anew, or is a report only.
            assert what == "command" or (name, how) == ("torques", "a jump of 1 rad"), (name, what, how)
            continue
        assert rig.mode == Mode.FAULT
        assert int(rig.cerebellum.take_flags()[1][0]) & Watchdog.GUARD
        if rig.cerebellum.n == 2:
            assert rig.cerebellum.mode[1] == Mode.TRACKING  # the other robot noticed nothing
        for _ in range(100):
            if controller.at_rest()[0]:
                break
            rig.tick(10)
        assert controller.at_rest()[0]
        for request in (Request.RESET, Request.ACTIVATE):
            assert rig.cerebellum.request(request, np.array([0])).accepted[0]
        rig.tick(50)
        assert rig.mode == Mode.HOLD


@pytest.mark.law
@pytest.mark.parametrize("by", [3e-3, 1e-3, 5e-4])
def test_rows_that_alternate_stop_the_arm(by: float) -> None:
    rig, link, _ = planned_arm()
    rows = link._memory.rows
    rows[..., ::2, 0, :6] += by
    rows[..., 1::2, 0, :6] -= by
    before = len(rig.plant.written)
    rig.tick(3)
    assert rig.mode == Mode.FAULT
    assert rig.cerebellum.take_flags()[1].tolist() == [Watchdog.GUARD]
    rig.tick(500)
    bend = np.abs(np.diff(np.array(rig.plant.written[before - 3 :])[:, 0], n=2, axis=0)).max(axis=0)
    hardest = arm_rig.STOP / arm_rig.HZ * (1 / arm_rig.HZ + 2 * arm_rig.LEAD)
    assert (bend <= 1.021 * hardest).all()
    assert np.abs(rig.plant.velocity).max() < 1e-6


def test_what_was_missed_is_not_caught_up_at_the_wire() -> None:
    rig = arm()
    assert rig.go(joint_target=arm_rig.posture(j0=1.5)) is None
    rig.tick(200)
    before = rig.plant.count
    for skipped in (1, 3, 10, 45):
        rig.now += skipped * arm_rig.TICK_NS
        rig.tick()
    assert rig.plant.count == before + 4
    rig.until(Mode.HOLD)
    assert rig.results() == [("1", ResultCode.SUCCEEDED)]


@pytest.mark.parametrize("make", [base_rig, twist_rig, arm])
@pytest.mark.parametrize("sign", [1, -1], ids=["old", "from the future"])
def test_a_reading_older_than_three_periods_or_a_period_ahead_is_a_fault(make: Callable[[], Any], sign: int) -> None:
    rig = make()
    hz = rig.cerebellum.control_hz
    period = 1_000_000_000 // hz
    rig.cerebellum.stamp_origin_ns = origin = 10**15
    ages = [0]
    read = rig.plant.read

    def stamped(out: Any) -> None:
        read(out)
        out.stamp_ns = np.array([origin + rig.now - ages[0]])

    rig.plant.read = stamped
    most = 3 if sign > 0 else 1  # periods
    for age in (0, 1, most):
        ages[0] = sign * age * period
        rig.tick(5)
        assert rig.mode == Mode.HOLD
    for wrong in (sign * (most * period + 1), sign * 10**10):
        ages[0] = wrong
        rig.tick()
        assert rig.mode == Mode.FAULT
        assert int(rig.cerebellum.take_flags()[1][0]) == Watchdog.PLANT
        assert ("of another clock" in rig.cerebellum.readings.problem) == (sign < 0)
        ages[0] = 0
        rig.tick(50)
        assert rig.mode == Mode.FAULT  # it latches
        for request in (Request.RESET, Request.ACTIVATE):
            assert rig.request(request).accepted.all()
        rig.tick(5)
        assert rig.mode == Mode.HOLD


@pytest.mark.parametrize("make", [base_rig, twist_rig])
@pytest.mark.parametrize("what", ["frozen", "one wheel", "the other way"])
def test_wheels_that_do_not_turn_as_commanded_are_a_fault(what: str, make: Callable[[int], support.Rig]) -> None:
    rig = make(2)
    read, fault_at = rig.plant.read, None
    frozen = np.zeros(2)

    def lie(out: Any) -> None:
        read(out)
        if what == "the other way":
            out.position[0] *= -1.0
        elif rig.now > support.NANOSECONDS:
            out.position[0, : 1 if what == "one wheel" else 2] = frozen[: 1 if what == "one wheel" else 2]
        else:
            frozen[:] = out.position[0]

    rig.plant.read = lie  # type: ignore[method-assign]
    driven = 0.0
    for tick in range(600):
        rig.send(0.2)
        rig.tick()
        if fault_at is None and rig.mode == Mode.FAULT:
            fault_at, driven = tick, float(rig.plant.position[0, 0])
    begin = 0 if what == "the other way" else support.HZ
    assert fault_at is not None
    assert fault_at - begin < 0.45 * support.HZ  # s: less than 0.1 m at full speed
    assert int(rig.cerebellum.take_flags()[1][0]) & Watchdog.BLOCKED
    assert (rig.plant.position[0, 0] - driven) * 0.033 < 0.012  # what the hardest stop needs
    assert rig.cerebellum.mode[1] == Mode.TRACKING  # the other robot noticed nothing


def test_a_plant_that_takes_twists_moves_as_one_that_takes_wheel_speeds() -> None:
    rng = np.random.default_rng(4)
    wheels, twists = base_rig(), twist_rig()
    for frame in range(200):
        command = (2.0 * rng.uniform(-TWIST, TWIST)).tolist()
        for rig in (wheels, twists):
            if frame % 60 == 59:
                rig.cerebellum.estop.press()
            if frame % 60 == 0 and frame:
                rig.tick(support.HZ)
                rig.request(Request.RESET)
                rig.request(Request.ACTIVATE)
            rig.send(*command)
        for _ in range(int(rng.integers(1, 30))):
            wheels.tick()
            twists.tick()
            np.testing.assert_array_equal(twists.plant.written, twists.cerebellum.command)
            np.testing.assert_allclose(twists.plant.velocity, wheels.plant.velocity, atol=1e-12)
    np.testing.assert_allclose(twists.plant.position, wheels.plant.position, atol=1e-9)
    assert np.abs(wheels.plant.position).max() > 1.0


@pytest.mark.parametrize(("turns", "is_fault"), [(1.0, False), (0.8, False), (0.0, True), (-1.0, True), (2.5, True)])
def test_wheels_that_turn_and_a_gyroscope_that_says_otherwise_are_a_fault(turns: float, is_fault: bool) -> None:
    """Slipping wheels, an encoder that counts too much, a gyroscope that hangs: nobody can tell which, but it stops."""
    rig = base_rig(2)
    controller = BaseController(support.BODY.drive, 2, support.HZ, gyro=0)
    rig.cerebellum = Cerebellum(support.BODY, rig.plant, support.HZ, controller, sensors=1)
    for request in (Request.CONFIGURE, Request.ACTIVATE):
        assert rig.request(request).accepted.all()
    fault_at = None
    for tick in range(400):
        rig.send(0.1, 1.0)
        rig.tick()
        yaw_rate = twist_from_wheels(support.BODY.drive, rig.plant.velocity)[:, 1]
        rig.cerebellum.reading.sensors[:, 0] = yaw_rate * (turns, 1.0) + 0.1  # which drifts a little
        if fault_at is None and rig.mode == Mode.FAULT:
            fault_at = tick
    assert rig.cerebellum.mode[1] == Mode.TRACKING
    assert (fault_at is not None) == is_fault
    if fault_at is not None:
        assert fault_at < 0.75 * support.HZ  # of which the first 0.3 s are those in which it begins to turn
        assert int(rig.cerebellum.take_flags()[1][0]) & Watchdog.PLANT


def test_however_many_setpoints_are_due_one_counts_and_a_tick_takes_its_time_for_one() -> None:
    for span in (0, 30 * support.TICK_NS):  # all at the same time, or one after the other
        rig = base_rig()
        rig.tick(100)
        for number in range(256):
            due = rig.now + span * (number - 255) // 256
            assert rig.send(0.001 * (number % 200), due=due).accepted.all()
        before = rig.cerebellum.setpoints_taken
        rig.tick()
        assert rig.cerebellum.setpoints_taken - before <= 2
        assert rig.cerebellum.requested[0, 0] == pytest.approx(0.001 * (255 % 200))  # the newest
        assert not len(rig.cerebellum.fifo)


def test_what_a_silent_brain_left_in_the_queue_moves_nothing_later() -> None:
    rig = base_rig()
    rig.send(0.1)
    rig.send(0.2, due=rig.now + 2 * support.NANOSECONDS)  # after the time-out
    rig.tick(support.HZ)
    assert rig.mode == Mode.HOLD
    assert rig.refused(Reason.STALE) == 1  # it is counted
    for _ in range(4 * support.HZ):
        rig.tick()
        assert not rig.plant.last.any()
    assert int(rig.cerebellum.take_flags()[1][0]) == Watchdog.COMMAND_AGE
    assert rig.send(0.1).accepted.all()  # a fresh one
    rig.tick(10)
    assert rig.mode == Mode.TRACKING


def test_a_command_is_never_taken_twice() -> None:
    """A process that puts the queue's ends back where they were: what was taken once is not taken again."""
    rig = base_rig()
    rig.send(0.2)
    rig.tick(10)
    queues = rig.cerebellum.fifo.queues
    rig.send(0.0)
    rig.tick(40)  # the first is not too old yet
    assert rig.command[0] == 0
    queues["waits"][0, 0] = True
    queues["tail"] = 0
    rig.cerebellum.states["seen_head"] = -1
    rig.tick(10)
    assert rig.command[0] == 0


@pytest.mark.parametrize(
    "ends", [(2**60, 0), (0, 2**60), (-5, 3), (10**6, 2), (2**63 - 1, -(2**63)), (-(2**62), 2**62)]
)
def test_garbage_in_the_queues_ends_empties_it(ends: tuple[int, int]) -> None:
    rig = base_rig()
    rig.send(0.2)
    rig.tick(10)
    rig.cerebellum.fifo.queues["head"], rig.cerebellum.fifo.queues["tail"] = ends
    rig.cerebellum.interrupt(Watchdog.BRAIN, Mode.STOPPING)
    rig.tick(300)
    assert rig.mode == Mode.HOLD
    assert rig.command == [0, 0]


def test_a_due_time_that_is_overwritten_in_the_queue_does_not_end_the_command_time_out() -> None:
    rig = base_rig()
    rig.send(0.2, due=5 * support.TICK_NS)
    rig.tick()
    rig.cerebellum.fifo.queues["due_ns"] = 2**62
    rig.tick(40)
    assert rig.mode == Mode.TRACKING
    rig.tick(200)
    assert rig.mode == Mode.HOLD
    assert rig.cerebellum.take_flags()[1].tolist() == [Watchdog.COMMAND_AGE]


def test_a_command_for_later_than_the_horizon_is_refused_and_dropped_from_the_queue() -> None:
    rig = base_rig()
    rates = Rates(support.HZ, support.HZ, 10)
    bridge = LockstepBridge(rig.cerebellum, rates, lambda: None)
    row = np.array([[0.1, 0.0]])
    assert bridge.send(row, due_ns=HORIZON_NS).accepted.all()
    assert bridge.send(row, due_ns=HORIZON_NS + 1).reasons.tolist() == [Reason.BEYOND_HORIZON]
    assert rig.refused(Reason.BEYOND_HORIZON) == 1
    for due, reason in ((2**62, Reason.BEYOND_HORIZON), (2**70, Reason.BEYOND_HORIZON), (-(2**70), Reason.STALE)):
        assert bridge.send(row, due_ns=due, replaces=True).reasons.tolist() == [reason]
        assert bridge.send(row, due_ns=HORIZON_NS).accepted.all()  # no clock shows it: the order is as it was
    rig.cerebellum.restart(np.array([0]))
    before = rig.refused(Reason.BEYOND_HORIZON)
    rig.cerebellum.fifo.push(1, 10 * HORIZON_NS, row, np.ones(1, np.bool_))  # another process, with another clock
    rig.tick()
    assert rig.cerebellum.states["next_due_ns"][0] == NEVER
    assert rig.refused(Reason.BEYOND_HORIZON) == before + 1


ABSURD = (2**62, 2**63 - 1, -(2**63), -1, 0, 1, 100 + 2**31)
"""Sequence numbers that another process writes beside a sender that has come to 4."""


@pytest.mark.parametrize("late", [0, 3 * support.TICK_NS])
@pytest.mark.parametrize("beside", [1, 3])
def test_numbers_of_a_second_sender_are_dropped_and_counted_and_take_no_command_of_the_first(
    late: int, beside: int
) -> None:
    rig = base_rig(2)
    everyone = np.ones(2, np.bool_)
    for _ in range(4):
        assert rig.send(0.05).accepted.all()
        rig.tick(10)
    bad = np.full((2, 2), 0.2)
    for number in ABSURD:
        refused, taken = rig.refused(Reason.OUT_OF_ORDER), rig.cerebellum.setpoints_taken
        for _ in range(beside):  # before and after the command, and all of them are due in the same tick
            rig.cerebellum.fifo.push(number, rig.now - late, bad, everyone)
        assert rig.send(0.05, due=rig.now - late).accepted.all()
        assert rig.send(0.1, due=rig.now - late).accepted.all()
        rig.cerebellum.fifo.push(number, rig.now - late, bad, everyone)
        rig.tick(10)
        assert rig.refused(Reason.OUT_OF_ORDER) - refused == beside + 1
        assert rig.cerebellum.setpoints_taken - taken in (2, 4)  # of two robots, one or both commands
        assert rig.cerebellum.requested[:, 0].tolist() == [0.1, 0.1]
        assert not len(rig.cerebellum.fifo)
    assert rig.mode == Mode.TRACKING


def test_a_sequence_number_that_no_sender_reaches_is_refused_and_the_next_command_is_taken() -> None:
    rig = base_rig()
    assert rig.send(0.1).accepted.all()
    for number in (2**62, 2**63, 2**70, -(2**70), 2 + 2**31):
        rows = np.array([[0.2, 0.0]])
        assert rig.cerebellum.offer(Setpoint(number, rig.now, rows)).reasons.tolist() == [Reason.OUT_OF_ORDER]
    assert rig.refused(Reason.OUT_OF_ORDER) == 5
    assert rig.send(0.1).accepted.all()
    rig.tick(60)
    assert rig.command[0] == pytest.approx(0.1)
    assert rig.cerebellum.restart(np.array([0])) is None  # a sender counts on, and may have come far
    assert [rig.request(one).accepted.all() for one in (Request.CONFIGURE, Request.ACTIVATE)] == [True, True]
    assert rig.send(0.1, sequence=10**9).accepted.all()


@pytest.mark.law
def test_an_arm_that_is_found_far_out_of_its_range_gets_no_command_before_it_was_moved_into_it() -> None:
    """The first command is where it is; where it may not be commanded to be, that would be a jump."""
    rig = arm_rig.Rig(active=False)
    rig.plant.position[0, 2] = ARM.limits.upper[2] + 0.3
    for request in (Request.CONFIGURE, Request.RESET):
        assert rig.request(request).reasons.tolist() == [Reason.FAULT]
        rig.tick(50)
    assert rig.mode == Mode.FAULT
    assert not rig.plant.written
    assert "elbow is found at 6.583 rad" in rig.cerebellum.readings.problem
    rig.plant.position[0, 2] = ARM.limits.upper[2] - 0.01
    where = rig.plant.position.copy()
    for request in (Request.RESET, Request.ACTIVATE):
        assert rig.request(request).accepted.all()
    rig.tick(5)
    assert rig.mode == Mode.HOLD
    np.testing.assert_array_equal(rig.plant.written, [where] * 5)
