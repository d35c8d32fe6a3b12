"""The impedance controller in the modes of the cerebellum, on joints that do not move."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Body
from bhd_lerobot.bodies.ur import MAX_OPENING, ur5
from bhd_lerobot.control.arm.compliance import Compliance
from bhd_lerobot.control.arm.impedance import ImpedanceController
from bhd_lerobot.control.geometry.dynamics import ArmDynamics
from bhd_lerobot.control.messages import Limit, Mode, Reason, Request
from bhd_lerobot.control.plant import Plant, PlantReading
from bhd_lerobot.errors import ConfigError
from tests.cases import each_case
from tests.control.arm_rig import HZ, Rig

Array = NDArray[np.float64]
ARM = ur5(actuation="torque")
EFFORT = np.array(ARM.limits.effort[:6])
HOME = np.array(ARM.arm.home)
DYNAMICS = ArmDynamics(ARM)


class StuckPlant(Plant):
    """Joints that stay where they are put or move at a given speed, whatever the motors do; with an encoder's noise."""

    n = 1

    def __init__(self) -> None:
        self.position, self.velocity, self.fault = HOME.copy(), np.zeros(7), False
        self.written: list[Array] = []
        self._noise = 1e-12

    def read(self, out: PlantReading) -> None:
        self._noise = -self._noise
        self.position += self.velocity / HZ
        out.position[0], out.velocity[0], out.safety[0] = self.position, self.velocity, self.fault
        out.position[:, :6] += self._noise
        out.velocity[:, :6] += self._noise

    def write(self, ctrl: Array) -> None:
        self.written.append(ctrl[0].copy())


class StuckRig(Rig):
    def __init__(self, hz: int = HZ) -> None:
        self.start(ARM, StuckPlant(), ImpedanceController(ARM, 1, hz, hz // 25), active=True, hz=hz)
        self.target = self.controller.command.copy()

    def send(self, frames: int = 1) -> None:  # type: ignore[override]
        for _ in range(frames):
            assert super().send(self.target).accepted.all()
            self.tick(self.hz // 25)


def test_the_command_is_the_pose_and_the_opening() -> None:
    rig = StuckRig()
    rig.tick()
    state = rig.cerebellum.state(rig.now)
    assert state.command.shape == (1, 8)
    np.testing.assert_allclose(state.measured, state.command, atol=1e-11)
    np.testing.assert_allclose(np.linalg.norm(state.command[:, 3:7]), 1.0)
    assert state.command[0, 7] == MAX_OPENING
    weight = DYNAMICS.terms(HOME[None, :6], np.zeros((1, 6))).gravity
    np.testing.assert_allclose(state.joint_efforts[:, :6], weight, atol=1e-9)


@pytest.mark.law
def test_a_wrench_needs_setpoints_and_ends_with_them_or_at_once_with_a_hard_stop() -> None:
    rig = StuckRig()
    rig.controller.set_wrench((10, 0, 0, 0, 0, 0))
    rig.tick(100)
    assert not rig.controller.wrench.any()
    rig.send(10)
    assert rig.controller.wrench[0, 0] == 10
    rig.tick(150)  # no more setpoints
    assert rig.mode == Mode.HOLD
    assert not rig.controller.wrench.any()
    rig.send(10)
    assert not rig.controller.wrench.any()  # it has to be asked for again
    rig.controller.set_wrench((10, 0, 0, 0, 0, 0))
    rig.send(10)
    assert rig.controller.wrench[0, 0] == 10
    rig.cerebellum.estop.press()
    rig.tick()
    assert not rig.controller.wrench.any()


def test_without_spring_and_damper_the_motors_carry_the_arms_own_dynamics() -> None:
    rig = StuckRig()
    rig.controller.set_compliance(Compliance(np.zeros(6), damping=np.zeros(6)))
    for share in np.linspace(0.0, 0.3, 100):
        rig.plant.velocity[:6] = share * np.array((0.5, -1.0, 1.5, 1.0, -1.0, 2.0))
        rig.tick()
    speeds = rig.plant.velocity[None, :6]
    terms = DYNAMICS.terms(rig.plant.position[None, :6], speeds)
    own = terms.coriolis[0] @ speeds[0] + terms.gravity[0]
    assert np.abs(terms.coriolis[0] @ speeds[0]).max() > 0.01
    np.testing.assert_allclose(rig.plant.written[-1][:6], own - 0.01 * EFFORT * speeds[0], atol=1e-9)


def test_a_wrench_comes_and_goes_gradually() -> None:
    rig = StuckRig()
    rig.controller.set_wrench((10, 0, 0, 0, 0, 0))
    values = []
    for _ in range(10):
        Rig.send(rig, rig.target)
        for _ in range(20):
            rig.tick()
            values.append(rig.controller.wrench[0, 0])
    assert np.diff(values).max() <= 100 / HZ + 1e-9


@pytest.mark.parametrize("wrench", [(1.0, 2.0), (np.nan, 0, 0, 0, 0, 0), (100.0, 0, 0, 0, 0, 0), (0, 0, 0, 0, 0, 20.0)])
def test_an_impossible_wrench_is_refused(wrench: tuple[float, ...]) -> None:
    with pytest.raises(ConfigError, match="wrench"):
        StuckRig().controller.set_wrench(wrench)


def test_motors_are_never_asked_for_more_than_they_have_nor_for_jumps() -> None:
    rig = StuckRig()
    rig.controller.set_compliance(Compliance((5000.0,) * 3 + (300.0,) * 3, max_force=120.0, max_moment=20.0))
    rig.target[0, :3] += 1.0
    rig.send(40)
    torque = np.array(rig.plant.written)[:, :6]
    assert (np.abs(torque) <= EFFORT).all()
    assert (np.abs(np.diff(torque, axis=0)) <= EFFORT / 50 + 1e-9).all()
    assert rig.cerebellum.take_flags()[0][0] & Limit.EFFORT


@pytest.mark.parametrize("value", [0.0, 1e-3, 1e200, np.nan])
def test_an_invalid_quaternion_in_the_queue_stops_the_arm(value: float) -> None:
    rig = StuckRig()
    rig.send()
    rig.target[0, 3:7] = (value, 0, 0, 0)
    rig.cerebellum.fifo.push(10**6, rig.now, rig.target, np.ones(1, np.bool_))  # as another process may
    rig.tick()
    assert rig.mode == Mode.FAULT
    assert rig.cerebellum.take_flags()[0][0] & Limit.NON_FINITE
    assert np.isfinite(rig.plant.written).all()
    np.testing.assert_allclose(rig.controller.command[0, :3], rig.cerebellum.state(rig.now).measured[0, :3])


def test_places_beyond_any_reach_are_clipped() -> None:
    rig = StuckRig()
    rig.target[0, 0], rig.target[0, 7] = 1e300, 1.0
    rig.send(20)
    assert rig.cerebellum.take_flags()[0][0] & Limit.POSITION
    assert rig.controller.command[0, 7] == pytest.approx(MAX_OPENING)
    assert np.isfinite(rig.controller.command).all()


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e300])
def test_a_spoilt_torque_reaches_neither_the_motors_nor_the_estimate_of_contacts(value: float) -> None:
    rig = StuckRig()
    rig.send(5)
    rig.controller.actuators[:] = value
    rig.tick(50)
    assert np.isfinite(rig.plant.written).all()
    np.testing.assert_allclose(rig.controller.contact_wrench, 0.0, atol=1.0)
    assert rig.mode == Mode.TRACKING


@pytest.mark.parametrize("hz", [50, 75, 100, 500, 1000])
def test_the_opening_stops_at_the_ends_of_its_range_at_any_rate(hz: int) -> None:
    rig = StuckRig(hz)
    for opening in (0.0, MAX_OPENING, -1.0, 1.0):
        rig.target[0, 7] = opening
        rig.send(25)
        assert rig.mode == Mode.TRACKING
        assert rig.plant.written[-1][6] == pytest.approx(np.clip(opening, 0.0, MAX_OPENING), abs=1e-6)
    opened = np.array(rig.plant.written)[:, 6]
    assert (opened >= 0.0).all()
    assert (opened <= MAX_OPENING).all()


def test_a_broken_encoder_is_a_fault_and_does_not_spread() -> None:
    rig = StuckRig()
    rig.send(5)
    rig.plant.position[2] = np.nan
    rig.tick(100)
    assert rig.mode == Mode.FAULT
    assert np.isfinite(rig.plant.written).all()


@pytest.mark.thorough(but=1)
@pytest.mark.parametrize("cause", [Mode.ESTOP, Mode.FAULT], ids=lambda mode: mode.name)
def test_a_hard_stop_holds_where_the_tool_is_and_soft_ones_what_was_commanded(cause: Mode) -> None:
    rig = StuckRig()
    measured = rig.cerebellum.state(rig.now).measured
    rig.target[0, 2] += 0.1
    rig.send(50)  # the plant is stuck: the equilibrium is 0.1 m away from the tool
    commanded = rig.controller.command.copy()
    rig.tick(200)
    assert rig.mode == Mode.HOLD
    np.testing.assert_allclose(rig.controller.command, commanded, atol=1e-5)
    if cause == Mode.ESTOP:
        rig.cerebellum.estop.press()
    else:
        rig.plant.fault = True
    rig.tick()
    assert rig.mode == cause
    np.testing.assert_allclose(rig.controller.command, measured, atol=1e-9)
    # Pressed again and again it stays the same stop, even if the arm is pushed away.
    rig.plant.position[0] += 0.1
    rig.cerebellum.estop.press()
    rig.tick()
    np.testing.assert_allclose(rig.controller.command, measured, atol=1e-9)


def test_a_hard_stop_is_over_when_the_joints_are_still() -> None:
    rig = StuckRig()
    rig.send(5)
    rig.plant.velocity[0] = 0.2
    rig.cerebellum.estop.press()
    rig.tick(5)
    assert rig.cerebellum.request(Request.RESET).reasons.tolist() == [Reason.NOT_AT_REST]
    rig.plant.velocity[0] = 0.0
    rig.tick(100)
    assert rig.cerebellum.request(Request.RESET).accepted.all()


def test_a_deactivation_brakes_and_ends_in_safe_off() -> None:
    rig = StuckRig()
    rig.target[0, 2] += 0.1
    rig.send(5)
    assert rig.cerebellum.request(Request.DEACTIVATE).accepted.all()
    rig.tick(300)
    assert rig.mode == Mode.SAFE_OFF


def test_a_restart_forgets_the_episode_before_and_which_limits_were_met() -> None:
    rig = StuckRig()
    rig.controller.set_wrench((10, 0, 0, 0, 0, 0))
    rig.target[0, 2] += 10.0
    rig.send(10)
    met = Limit.VELOCITY | Limit.ACCELERATION
    assert Limit(int(rig.cerebellum.take_flags()[0][0])) & met == met
    rig.send()
    rig.cerebellum.restart(np.array([0]))
    assert rig.cerebellum.take_flags()[0].tolist() == [Limit.NONE]
    assert rig.controller.contact_wrench.tolist() == [[0] * 6]
    rig.tick(50)  # not configured: it stays where it is
    np.testing.assert_allclose(rig.controller.command, rig.cerebellum.state(rig.now).measured, atol=1e-9)
    assert not rig.controller.wrench.any()


@each_case(
    ("body", "hz", "message"),
    [
        (ur5(), HZ, "actuation"),
        (replace(ARM, arm=replace(ARM.arm, actuation="position")), HZ, "actuation"),
        (ARM, 49, "control_hz is 49"),  # too few ticks for the estimate of contacts
    ],
)
def test_a_position_servo_and_too_few_ticks_are_refused(body: Body, hz: int, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        ImpedanceController(body, 1, hz, 20)
