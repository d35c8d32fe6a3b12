"""Sensors that lie: whatever they read, nothing moves after the stop by more than giving way needs. On physics."""

from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks import wire
from bhd_lerobot.bodies.tabletop import TableScene
from bhd_lerobot.control.messages import Mode, Request, Watchdog
from bhd_lerobot.control.plant import PlantReading
from bhd_lerobot.robots.config_ur import UR5Config
from bhd_lerobot.robots.host.simulation import Simulation
from tests.robots.forces import Wall

Array = NDArray[np.float64]
Lie = Callable[[PlantReading, float], None]
"""Falsifies the readings of all arms; seconds since the lie began, from 0 on."""

HZ = 500
BRAKES = 0.03  # [rad] from 0.4 rad/s


class Lied:
    """UR5s of which each turns one joint with 0.4 rad/s, and whose readings are falsified after half a second."""

    def __init__(self, joints: Any, lie: Lie) -> None:
        self.joints = np.asarray(joints)
        self.all = np.arange(len(self.joints))
        self.arm = arm = Simulation(UR5Config(), len(self.joints))
        arm.reset(self.all, [TableScene("empty", (), arm.body.arm.home)] * len(self.joints), self.all.tolist())
        self.cerebellum: Any = arm.cerebellum
        self.true: list[Array] = []
        self.modes: list[Array] = []
        read = self.cerebellum.plant.read

        def falsified(out: PlantReading) -> None:
            read(out)
            self.true.append(out.position[:, :6].copy())
            self.modes.append(self.cerebellum.mode.copy())
            if len(self.true) > HZ // 2:
                lie(out, (len(self.true) - HZ // 2 - 1) / HZ)

        self.cerebellum.plant.read = falsified
        self.action = self.cerebellum.command.copy()
        self.watchdog = np.zeros(len(self.joints), np.int64)

    def turn(self, seconds: float) -> None:
        for _ in range(round(seconds * 25)):
            self.action[self.all, self.joints] += 0.4 / 25
            self.watchdog |= self.arm.step(self.action).watchdog

    def moved(self, mode: Any = Mode.FAULT) -> Array:
        """How far the joint of each arm that moved most was from where the stop found it, by physics [rad]."""
        assert (self.cerebellum.mode == mode).all(), self.cerebellum.mode
        true, stopped = np.array(self.true), np.array(self.modes) >= Mode.ESTOP
        first = stopped.argmax(axis=0)
        away = np.abs(true - true[first, self.all]).max(axis=2)
        return np.where(stopped, away, 0.0).max(axis=0)

    def reset(self, is_accepted: Any = True) -> None:
        for request in (Request.RESET, Request.ACTIVATE):
            assert (self.cerebellum.request(request).accepted == is_accepted).all()


def test_a_step_of_an_encoder_is_a_fault_that_is_not_followed() -> None:
    by = np.repeat([0.12, 0.30, 1.0, -0.30], 6)
    joints = np.tile(np.arange(6), 4)

    def step(out: PlantReading, _: float) -> None:
        out.position[np.arange(24), joints] += by

    lied = Lied(joints, step)
    lied.turn(1.5)
    assert (lied.moved() < BRAKES).all()
    assert (lied.watchdog & Watchdog.PLANT).all()
    assert "faster than it can turn" in lied.arm.problem


def test_angles_that_are_wrapped_are_a_fault_that_says_so() -> None:
    """The home position of the shoulder pan is pi."""

    def wrap(out: PlantReading, _: float) -> None:
        out.position[:, :6] = (out.position[:, :6] + np.pi) % (2 * np.pi) - np.pi

    lied = Lied([0, 1], wrap)
    lied.turn(1.5)
    assert (lied.moved() < BRAKES).all()
    assert "shoulder_pan reads a change of -6.2" in lied.arm.problem
    assert "its angles are wrapped" in lied.arm.problem


def test_an_encoder_that_drifts_brings_the_joint_no_further_than_one_that_is_blocked() -> None:
    """As fast as the joint can turn, for ever: by its reading it never rests, and the stop ends all the same."""
    rate = np.tile([0.3, 1.0, 3.0, -1.0, -6.0], 3)
    joints = np.repeat([0, 1, 3], 5)

    def drift(out: PlantReading, seconds: float) -> None:
        out.position[np.arange(15), joints] += rate * seconds
        out.velocity[np.arange(15), joints] += rate

    lied = Lied(joints, drift)
    lied.turn(3.0)
    assert (lied.moved() < 0.1 + 0.07 * np.abs(rate) + BRAKES).all()
    assert np.ptp(np.array(lied.true)[-HZ:], axis=0).max() < 1e-3
    # After a reset it stays where it is, and is stopped again. What reads far out of its range is not reset.
    read = lied.true[-1][lied.all, joints] + rate * (len(lied.true) / HZ - 0.5)
    is_within = np.abs(read) < 2 * np.pi + 0.1
    assert 0 < is_within.sum() < 15
    lied.reset(is_within)
    where = lied.true[-1]
    lied.action = lied.cerebellum.command.copy()
    lied.turn(0.5)
    assert (lied.cerebellum.mode == Mode.FAULT).all()
    assert np.abs(lied.true[-1] - where).max() < BRAKES


def test_an_encoder_that_freezes_with_fresh_stamps() -> None:
    held: list[Array] = []

    def freeze(out: PlantReading, _: float) -> None:
        own = np.arange(6)
        held[:] = held or [out.position[own, own].copy()]
        out.position[own, own], out.velocity[own, own] = held[0], 0.0

    lied = Lied(range(6), freeze)
    lied.turn(2.0)
    assert (lied.moved() < 0.1 + 0.1 * 0.4 + BRAKES).all()
    assert (lied.watchdog & Watchdog.BLOCKED).all()


def together(lies: Sequence[Lie], each: int) -> Lie:
    """Falsify the readings of so many arms by each lie."""

    def lie(out: PlantReading, seconds: float) -> None:
        for number, one in enumerate(lies):
            rows = slice(number * each, (number + 1) * each)
            of_these: Any = SimpleNamespace(
                position=out.position[rows], velocity=out.velocity[rows], effort=out.effort[rows]
            )
            one(of_these, seconds)

    return lie


def _drift(out: PlantReading, seconds: float) -> None:
    out.position[:, 1] += [0.3 * seconds, -0.3 * seconds, min(seconds, 1.0), 2.0 * seconds]
    out.velocity[:, 1] += [0.3, -0.3, seconds < 1.0, 2.0]


def _jump(out: PlantReading, _: float) -> None:
    out.position[np.arange(4), [0, 1, 2, 3]] += 0.5


def _break(out: PlantReading, _: float) -> None:
    out.position[np.arange(4), [0, 1, 2, 3]] = np.nan


def _freeze() -> Lie:
    held: list[Array] = []

    def freeze(out: PlantReading, _: float) -> None:
        held[:] = held or [out.position[:, :6].copy()]
        out.position[:, :6], out.velocity[:, :6] = held[0], 0.0

    return freeze


def test_an_arm_whose_encoders_are_wrong_gives_way_by_its_efforts() -> None:
    lied = Lied([0, 1, 2, 3] * 4, together([_freeze(), _drift, _jump, _break], 4))
    lied.turn(1.5)
    assert (lied.moved() < 0.1 + 0.1 * 0.4 + 0.07 * 2.0 + BRAKES).all()
    directions, most = [(1.0, 0, 0), (0, 1.0, 0), (0, -1.0, 0), (0.3, 0.4, 1.0)] * 4, np.zeros(16)
    wall = Wall(lied.arm, directions, 0.05, 2.0)
    for _ in range(75):
        lied.arm.step(None)
        np.maximum(most, wall.force, out=most)
    assert ((most > 0.0) & (most < 250.0)).all()
    assert (wall.force < 20.0).all()


@pytest.mark.parametrize("lie", ["drifting", "frozen", "counting twice"])
def test_whatever_is_read_nothing_becomes_faster_by_the_stop(lie: str) -> None:
    """Arms that sway: where efforts contradict an encoder, it is not followed."""
    one = wire.deceive("joints", lie, 12, 50, 3)
    assert one.stopped > 6
    assert one.faster < wire.FASTER
    assert one.moved < wire.NEEDED["joints"][lie]


@pytest.mark.parametrize("lie", ["frozen", "counting twice"])
def test_without_efforts_a_blocked_arm_brakes_along_its_reference(lie: str) -> None:
    arm: Any = wire.make("joints", 12)
    read, first = arm.cerebellum.plant.read, wire.start_of(arm)

    def without_efforts(out: PlantReading) -> None:
        read(out)
        out.effort[:], out.has_effort = 0.0, False

    arm.cerebellum.plant.read = without_efforts
    liar = arm.cerebellum.plant = wire.Liar(arm, lie, np.random.default_rng(3))
    for frame in range(50):
        arm.step(first + np.array([0.5] * 6 + [0.0]) * np.sin(2.0 * frame / 25))
    assert (arm.modes == Mode.FAULT).sum() > 6
    assert liar.faster.max() < wire.FASTER


def _drifts(rate: float) -> Lie:
    def drift(out: PlantReading, seconds: float) -> None:
        out.effort[:, 1] += rate * seconds

    return drift


def _comes_and_goes(period: float) -> Lie:
    def come_and_go(out: PlantReading, seconds: float) -> None:
        out.effort[:, 0] += np.array([90.0, -60.0]) * (seconds % period < period / 2)

    return come_and_go


def _becomes(value: float) -> Lie:
    def become(out: PlantReading, seconds: float) -> None:
        if seconds > 0.2:
            out.effort[:] = value

    return become


def _is_wrong(speeds: tuple[float, float]) -> Lie:
    def lie(out: PlantReading, _: float) -> None:
        out.velocity[:, 1] = speeds

    return lie


AFTER_A_STOP: list[tuple[Lie, Mode, tuple[int, int], float]] = [  # the stop, the joints that turned, how far they move
    # Nothing presses on the arm, and its servos are not stretched.
    *((_drifts(rate), Mode.ESTOP, (0, 1), 0.25) for rate in (20.0, -100.0)),
    # While they are right, efforts agree with the positions: that nothing presses confirms no push.
    *((_comes_and_goes(period), Mode.ESTOP, (0, 1), 0.25) for period in (0.8, 1.5)),
    # It gives way by what is read of its joints, and not to a weight that it does not feel.
    *((_becomes(value), stop, (0, 1), BRAKES) for value in (0.0, np.nan) for stop in (Mode.ESTOP, Mode.FAULT)),
    *((_is_wrong(speeds), Mode.ESTOP, (0, 0), BRAKES) for speeds in ((2.0, -2.0), (1e6, -1e6))),
]


def test_efforts_and_speeds_that_are_wrong_after_a_stop_move_no_arm_further_than_its_positions_confirm() -> None:
    lies, stops, joints, most = zip(*AFTER_A_STOP, strict=True)
    lied, stop = Lied(np.concatenate(joints), together(lies, 2)), np.repeat(stops, 2)
    lied.turn(0.6)
    lied.cerebellum.estop.press(np.flatnonzero(stop == Mode.ESTOP))
    lied.turn(0.04)
    lied.cerebellum.interrupt(Watchdog.MISSES, Mode.FAULT)
    lied.turn(4.0)
    moved = lied.moved(stop)
    assert (moved < np.repeat(most, 2)).all(), moved
    assert np.ptp(np.array(lied.true)[-HZ:, :4], axis=0).max() < 1e-3  # also while efforts drift on
    wrong_speeds = lied.all[-4:]
    for request in (Request.RESET, Request.ACTIVATE):
        assert lied.cerebellum.request(request, wrong_speeds).accepted[wrong_speeds].all()


def test_after_an_emergency_stop_an_arm_gives_way_once_and_not_again_to_the_same_reading() -> None:
    """Off by less than what is found to be blocked: by all that can be known, it presses on something."""
    by = np.array([0.09, -0.09])

    def creep(out: PlantReading, seconds: float) -> None:
        out.position[:, 1] += by * min(seconds, 1.0)

    lied = Lied([0, 1], creep)
    lied.turn(2.0)
    lied.cerebellum.estop.press()
    lied.turn(3.0)
    assert (lied.moved(Mode.ESTOP) < 0.09 + 0.05 + BRAKES).all()


@pytest.mark.parametrize("is_moving", [True, False])
def test_efforts_of_zero_are_a_fault_that_names_them_and_moves_nothing(is_moving: bool) -> None:
    def zeros(out: PlantReading, _: float) -> None:
        out.effort[:] = 0.0

    lied = Lied([0, 1, 5], zeros)
    if is_moving:
        lied.turn(0.8)
    else:
        for _ in range(20):
            lied.arm.step(None)
    assert (lied.moved() < BRAKES).all()
    assert (lied.modes[-1] == Mode.FAULT).all()
    assert "efforts that the plant reads are 0 while the motors carry the arm" in lied.cerebellum.controller.cause
    for _ in range(2):  # and again after each reset, for as long as it is so
        lied.reset()
        for _ in range(5):
            lied.arm.step(None)
        assert (lied.cerebellum.mode == Mode.FAULT).all()
    assert (lied.moved() < BRAKES).all()


def test_efforts_that_are_zero_in_between_leave_the_limit_of_force_as_it_is() -> None:
    """As of a driver that fills the field with zeros in every other message: nothing else is less."""
    rng = np.random.default_rng(3)

    def lie(out: PlantReading, _: float) -> None:
        out.effort[rng.random(2) < 0.7, :] = 0.0

    lied = Lied([1, 2], lie)
    lied.turn(1.0)
    lied.action[:, 2] -= 0.8
    lied.turn(0.8)
    assert (lied.cerebellum.mode == Mode.TRACKING).all()
    assert lied.cerebellum.controller.force.max() < 60.0


def test_an_emergency_stop_in_a_fault_lets_an_arm_with_wrong_encoders_give_way_no_further() -> None:
    """By efforts that change all the time, as of something that pushes on and on."""

    def lie(out: PlantReading, seconds: float) -> None:
        out.position[:, 1] += [0.5, -0.5]
        out.effort[:, 0] += np.array([60.0, -60.0]) * (1.0 + 0.5 * np.sin(3.0 * seconds)) * (seconds > 0.5)

    lied = Lied([0, 1], lie)
    lied.turn(6.0)
    assert (lied.moved() > 0.5).all()
    lied.cerebellum.estop.press()
    lied.turn(8.0)
    assert (lied.moved(Mode.ESTOP) < 1.0 + BRAKES + 0.1).all()


def test_what_is_no_number_leaves_no_blind_limit_of_force() -> None:
    def lie(out: PlantReading, seconds: float) -> None:
        if seconds == 0:
            out.effort[0, 2] = out.velocity[1, 2] = np.nan

    lied = Lied([0, 0, 0], lie)
    lied.turn(1.0)
    assert lied.cerebellum.mode.tolist() == [Mode.FAULT, Mode.FAULT, Mode.TRACKING]
    for request in (Request.RESET, Request.ACTIVATE):
        assert lied.cerebellum.request(request, np.arange(2)).accepted[:2].all()
    lied.action = lied.cerebellum.command.copy()
    lied.turn(1.0)
    assert (lied.cerebellum.mode == Mode.TRACKING).all()
    assert np.isfinite(lied.cerebellum.controller.arms["torque"]).all()
