"""Impedance control under readings that are no measurements, surroundings that change, and closed brakes."""

import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks._impedance_attacks import ATTACKS, attack
from benchmarks.wire import Judge, make
from bhd_lerobot.control.arm.compliance import Compliance
from bhd_lerobot.control.messages import Mode, Reason
from bhd_lerobot.control.plant import Plant, PlantReading
from tests.robots.impedance_rig import Rig, forward_posture

Array = NDArray[np.float64]


@pytest.mark.parametrize("kind", ATTACKS)
def test_an_attack_makes_no_arm_fast_and_presses_no_harder_than_stated(kind: str) -> None:
    arm = make("impedance", 4)
    judge = arm.cerebellum.plant = Judge(arm)
    effect = attack(arm, kind, 50, 1)
    assert effect.is_safe(kind), effect
    assert judge.unsafe == 0
    if kind in ("frozen", "one frozen", "wrong sign", "late", "false", "from the future"):
        assert effect.stopped == 1.0


def test_the_measurement_of_an_attack_is_not_blind() -> None:
    """Without supervision late readings make the tool faster than is stated."""
    arm = make("impedance", 2)
    for name in ("most_speed", "most_tool_speed", "most_torque", "most_force", "most_swings"):
        arm.controller.arm_limits[name] = np.inf
    assert not attack(arm, "late", 50, 1).is_safe("late")


def test_speeds_of_a_coarse_encoder_are_no_fault() -> None:
    """They are the same number for long; that they are none of the positions' would be found all the same."""
    arm = make("impedance", 4)
    read = arm.cerebellum.plant.read

    def coarse(out: PlantReading) -> None:
        read(out)
        out.position[:, :6] = np.round(out.position[:, :6], 5)
        out.velocity[:, :6] = np.round(out.velocity[:, :6] / 0.005) * 0.005

    arm.cerebellum.plant.read = coarse
    first = arm.cerebellum.command.copy()
    for frame in range(90):
        action = first.copy()
        action[:, :3] += 0.1 * (frame >= 25) * np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 1, 1]])
        arm.step(action)
    assert (arm.modes == Mode.TRACKING).all(), arm.problem


class DriftingPlant(Plant):
    """A plant whose positions and speeds drift from a moment on, all joints alike."""

    n = 1

    def __init__(self, plant: Plant) -> None:
        self._plant, self.drift, self._ticks = plant, 0.0, 0

    def read(self, out: PlantReading) -> None:
        self._plant.read(out)
        self._ticks += bool(self.drift)
        out.position[:, :6] += self.drift * self._ticks / 500
        out.velocity[:, :6] += self.drift

    def write(self, ctrl: Array) -> None:
        self._plant.write(ctrl)

    def set_mode(self, mode: NDArray[np.int8]) -> None:
        self._plant.set_mode(mode)


@pytest.mark.parametrize("mode", [Mode.ESTOP, Mode.FAULT, Mode.SAFE_OFF, Mode.INACTIVE], ids=lambda mode: mode.name)
def test_in_modes_without_motion_no_reading_moves_the_arm(mode: Mode) -> None:
    rig = Rig()
    plant = rig.cerebellum.plant = DriftingPlant(rig.cerebellum.plant)
    rig.move((0.0, 0.05, 0.0), 0.1)
    if mode == Mode.FAULT:
        plant.drift = 1e4  # no joint turns so fast
        rig.wait(0.002)
    elif mode == Mode.SAFE_OFF:
        rig.bridge.deactivate()
    else:
        rig.bridge.estop()
    rig.wait(1.0)
    if mode == Mode.INACTIVE:
        assert rig.bridge.reset().accepted.all()
        rig.wait(0.1)
    assert rig.mode == mode
    posture = rig.world.qpos[0, :6].copy()
    plant.drift = 0.2
    rig.wait(3.0)
    assert np.abs(rig.world.qpos[0, :6] - posture).max() < 0.02


def test_closed_brakes_give_way_to_what_pushes_and_a_reset_is_refused_until_it_is_gone() -> None:
    rig = Rig()
    rig.bridge.estop()
    rig.wait(2.0)
    start = rig.log["tool"][-1]
    rig.push[:3] = (-90.0, 0.0, 0.0)
    rig.wait(1.0)
    pushed = rig.log["tool"][-1]
    assert (pushed - start)[0] < -0.01
    refusal = rig.bridge.reset()
    assert refusal.reasons.tolist() in ([Reason.PRESSED], [Reason.NOT_AT_REST])
    rig.push[:] = 0.0
    rig.wait(1.0)
    assert np.linalg.norm(rig.log["tool"][-1] - pushed) < 0.01  # it does not come back by itself
    assert rig.bridge.reset().accepted.all()
    assert rig.bridge.activate().accepted.all()
    rig.wait(0.5)
    assert np.linalg.norm(rig.log["tool"][-1] - pushed) < 0.01


def put_back(rig: Rig, turned: float = 0.0) -> None:
    """Put the arm somewhere else, its shoulder raised by an angle [rad], and let the controller forget the rest."""
    rig.world.reset()
    rig.world.qpos[:, :6] = forward_posture()
    rig.world.qpos[:, 1] -= turned
    rig.world.hold()
    rig.cerebellum.restart(np.arange(1))


def test_brakes_are_closed_however_early_after_a_restart_something_presses() -> None:
    ways = []
    for is_closed in (False, True):
        rig = Rig()
        if is_closed:  # they are when it is put back
            rig.bridge.estop()
            rig.wait(0.1)
        put_back(rig)
        rig.bridge.estop()
        rig.wait(0.002)
        start, rig.push[0] = rig.log["tool"][-1], -20.0
        rig.wait(0.5)
        ways.append(np.linalg.norm(rig.log["tool"][-1] - start))
    assert ways[1] == pytest.approx(ways[0], rel=0.05)


@pytest.mark.parametrize("turned", [0.3, 0.8])
def test_an_arm_that_is_not_configured_stays_where_it_was_put(turned: float) -> None:
    rig = Rig()
    put_back(rig, turned)
    posture = rig.world.qpos[0, :6].copy()
    rig.wait(1.0)
    assert rig.mode == Mode.UNCONFIGURED
    assert np.abs(rig.world.qpos[0, :6] - posture).max() < 0.002


@pytest.mark.parametrize(("damping", "most"), [(1400.0, 17.0), (100.0, 12.0)])
def test_a_damper_presses_a_wall_no_harder_than_stated(damping: float, most: float) -> None:
    rig = Rig(wall=True, compliance=Compliance((0.0,) * 6, damping=(damping,) * 3 + (20.0,) * 3, max_force=10.0))
    rig.move((0.2, 0.0, 0.0), 0.05)
    assert rig.mode == Mode.TRACKING
    pressed = np.linalg.norm(rig.logged("force", -500), axis=1)
    assert 1.0 < pressed.mean() < most


def test_what_rests_on_an_arm_forbids_its_activation_with_the_force() -> None:
    rig = Rig()
    rig.push[:3] = (0.0, 0.0, -25.0)
    rig.bridge.estop()
    rig.wait(3.0)
    assert rig.bridge.reset().reasons.tolist() == [Reason.PRESSED]
    assert rig.bridge.state().pressed[0] == pytest.approx(25.0, abs=2.0)
