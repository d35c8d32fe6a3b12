"""Impedance in closed loop: against a rigid wall, under known forces, and in free motion. Truth is the engine's."""

import runpy
import sys
from pathlib import Path

import numpy as np
import pinocchio
import pytest

from bhd_lerobot.control.arm.compliance import Compliance
from bhd_lerobot.control.geometry.dynamics import ArmDynamics
from bhd_lerobot.control.messages import Limit, Mode, Watchdog
from tests.robots.impedance_rig import ARM, START, Rig

ROOT = Path(__file__).resolve().parents[2]
EFFORT = np.array(ARM.limits.effort[:6])
PUSH = (10.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def pushing(speed: float = 0.02, peak: float = 25.0) -> Rig:
    """Return a rig that came to the wall at a speed, has been pushing on it with 10 N, and did so as it should."""
    rig = Rig(wall=True)
    rig.move((0.07, 0, 0), 0.1)
    rig.keep(0.2)
    rig.approach(speed)
    rig.controller.set_wrench(PUSH)
    rig.keep(1.2)
    force, estimate = rig.logged("force"), rig.logged("estimate")
    onset = int(np.flatnonzero(force[:, 0])[0])
    assert -force.min() < peak
    assert np.abs(force[onset + 250 :] - (-10, 0, 0)).max() < 1.0  # settled half a second after the contact
    assert np.abs(force[-250:] - (-10, 0, 0)).max() < 0.5
    assert np.abs(estimate[-250:, :3] - force[-250:]).max() < 0.2
    assert (force[onset:, 0] < 0).all()  # it does not bounce
    assert np.linalg.norm(estimate[:onset, :3], axis=1).max() < 0.2
    assert (np.abs(rig.logged("torque")) <= EFFORT).all()
    return rig


def test_it_pushes_on_a_rigid_wall_until_no_commands_come_and_lets_go_cleanly() -> None:
    rig = pushing()
    rig.cerebellum.take_flags()
    commanded = rig.controller.command.copy()
    rig.wait(0.5)
    assert rig.mode == Mode.HOLD
    assert rig.cerebellum.take_flags()[1][0] == Watchdog.COMMAND_AGE
    assert not rig.controller.wrench.any()
    rig.wait(0.4)
    assert abs(rig.log["force"][-1][0]) < 1.0
    np.testing.assert_allclose(rig.controller.command, commanded, atol=1e-6)

    rig.controller.set_wrench(PUSH)
    rig.keep(0.6)
    assert abs(rig.log["force"][-1][0] + 10) < 1
    since = rig.ticks
    rig.controller.set_wrench(np.zeros(6))
    rig.move((-0.03, 0, 0), 0.05)
    rig.keep(0.5)
    force = rig.logged("force", since)[:, 0]
    gone = int(np.flatnonzero(force == 0)[0])
    assert force[:gone].min() > -10.5
    assert (force[gone:] == 0).all()
    assert np.abs(rig.log["estimate"][-1]).max() < 0.05
    np.testing.assert_allclose(rig.log["tool"][-1], rig.target[0, :3], atol=1e-3)


@pytest.mark.thorough
def test_a_wall_in_the_way_of_a_far_target_is_pushed_no_harder_than_allowed() -> None:
    rig = Rig(wall=True, compliance=Compliance(max_force=30.0))
    rig.move((0.07, 0, 0), 0.1)
    rig.approach(0.02)
    since = rig.ticks
    rig.target[:, 0] += 0.3
    rig.keep(2.2)
    assert abs(rig.log["force"][-1][0] + 30) < 1.0
    # On its way in the equilibrium is 250 mm/s faster than the tool, which the damper feels.
    assert rig.logged("force", since)[:, 0].min() > -80
    assert rig.cerebellum.take_flags()[0][0] & Limit.EFFORT


def test_an_emergency_stop_in_contact_presses_no_more_and_stays() -> None:
    rig = pushing(speed=0.05, peak=60.0)
    since = rig.ticks
    rig.bridge.estop()
    rig.wait(1.2)
    force, tool = rig.logged("force", since)[:, 0], rig.logged("tool", since)
    assert rig.mode == Mode.ESTOP
    assert force.min() > -10.5
    assert np.abs(force[250:]).max() < 1.0
    assert np.linalg.norm(tool - tool[0], axis=1).max() < 2e-3
    assert not rig.controller.wrench.any()
    assert not rig.bridge.send(rig.target).accepted.any()
    assert rig.bridge.reset().accepted.all()
    assert rig.bridge.activate().accepted.all()
    rig.wait(0.5)
    assert abs(rig.log["force"][-1][0]) < 1.0  # the push does not come back by itself
    rig.target[:] = rig.controller.command
    rig.move((-0.05, 0, 0), 0.1)
    assert rig.mode == Mode.TRACKING
    assert rig.log["force"][-1][0] == 0


def test_an_emergency_stop_in_motion_ends_near_to_where_it_was_pressed() -> None:
    rig = Rig()
    rig.move((0, -0.15, 0), 0.25)
    pressed = rig.log["tool"][-1]
    rig.bridge.estop()
    rig.wait(0.02)
    assert not rig.bridge.reset().accepted.any()  # not at rest yet
    rig.wait(2.0)
    away = np.linalg.norm(rig.logged("tool", -1000) - pressed, axis=1)
    assert away.max() < 0.02
    assert np.ptp(away[-500:]) < 1e-5  # its brakes hold it where it came to rest
    assert rig.bridge.reset().accepted.all()


@pytest.mark.thorough
def test_a_stop_in_motion_brakes_the_equilibrium_and_holds_it_where_it_stops() -> None:
    rig = Rig()
    rig.move((0, -0.15, 0), 0.25)
    since = rig.ticks
    rig.wait(1.2)
    command = rig.logged("command", since)[:, :3]
    speed = np.linalg.norm(np.diff(command, axis=0), axis=1) * 500
    assert rig.mode == Mode.HOLD
    assert (np.abs(np.diff(speed)) * 500 <= 1.0 + 1e-6).all()  # [m/s^2]
    assert speed[-1] == 0
    np.testing.assert_allclose(rig.log["tool"][-1], command[-1], atol=1e-3)


@pytest.mark.thorough(but=1)
@pytest.mark.parametrize("force", [(20.0, 0.0, 0.0), (-5.0, 8.0, -12.0)])
def test_a_force_moves_the_tool_by_force_over_stiffness_and_is_felt(force: tuple[float, float, float]) -> None:
    stiffness = np.diag([400.0, 800.0, 600.0, 40.0, 40.0, 40.0])
    rig = Rig(compliance=Compliance(stiffness))
    rig.push[:3] = force
    rig.wait(1.4)
    size = np.linalg.norm(force)
    moved = stiffness[:3, :3] @ (rig.log["tool"][-1] - START)
    assert np.linalg.norm(moved - force) < 0.05 * size
    assert np.linalg.norm(rig.log["estimate"][-1][:3] - force) < 0.05 * size
    # The estimate is there long before the tool is: it settles within 0.1 s.
    assert np.linalg.norm(rig.log["estimate"][50][:3] - force) < 0.1 * size


def test_a_moment_is_felt() -> None:
    rig = Rig()
    rig.push[3:] = (1.0, 0.5, -1.0)
    rig.wait(0.5)
    np.testing.assert_allclose(rig.log["estimate"][-1], (0, 0, 0, 1.0, 0.5, -1.0), atol=0.05)


@pytest.mark.thorough(but=1)
@pytest.mark.parametrize("damping", [None, (100.0, 100.0, 100.0, 4.0, 4.0, 4.0)])
def test_a_free_response_loses_energy_in_every_tick(damping: tuple[float, ...] | None) -> None:
    rig = Rig(compliance=Compliance(damping=damping))
    rig.world.qpos[:, :6] += (0.05, -0.04, 0.05, 0.1, -0.1, 0.2)
    rig.cerebellum.readings.forget(np.arange(1))  # it was put there: no joint turns so fast
    equilibrium, dynamics = rig.controller.springs[0], ArmDynamics(ARM)
    stiffness = np.diag(np.asarray(Compliance().stiffness).diagonal())
    energies = []
    for _ in range(750):
        q, v = rig.world.qpos[:, :6], rig.world.qvel[:, :6]
        terms = dynamics.terms(q, v)
        there = pinocchio.Quaternion(*equilibrium["turn"].tolist()).matrix()
        turn = pinocchio.log3(there @ terms.tool[0, :3, :3].T)
        error = np.concatenate([equilibrium["place"] - terms.tool[0, :3, 3], turn])
        energies.append(0.5 * error @ stiffness @ error + 0.5 * v[0] @ terms.mass[0] @ v[0])
        rig.bridge.advance_ticks(1)
    assert energies[0] > 1.0
    assert np.diff(energies).max() < 1e-6
    assert energies[-1] < 1e-3 * energies[0]


@pytest.mark.thorough
def test_no_contact_is_felt_in_free_motion_at_full_speed() -> None:
    rig = Rig()
    rig.move((0, -0.25, 0), 0.25)
    rig.keep(0.3)
    rig.move((-0.06, 0, 0.12), 0.25)
    rig.keep(0.3)
    estimate = rig.logged("estimate")
    assert np.linalg.norm(np.diff(rig.logged("tool"), axis=0), axis=1).max() * 500 > 0.24
    assert np.linalg.norm(estimate[:, :3], axis=1).max() < 0.2
    assert np.linalg.norm(estimate[:, 3:], axis=1).max() < 0.1


@pytest.mark.thorough
def test_a_stretched_arm_stays_calm() -> None:
    """Beyond its reach the arm is singular: the equilibrium goes on, the tool cannot."""
    rig = Rig()
    rig.move((0.6, 0, 0.2), 0.25)
    rig.keep(2.0)
    speed = np.linalg.norm(np.diff(rig.logged("tool", -500), axis=0), axis=1) * 500
    assert speed.max() < 0.01
    assert (np.abs(rig.logged("torque")) < EFFORT).all()
    rig.move((-0.6, 0, -0.2), 0.25)
    rig.keep(1.0)
    np.testing.assert_allclose(rig.log["tool"][-1], START, atol=2e-3)


@pytest.mark.thorough
def test_one_of_several_arms_does_bit_for_bit_what_one_does() -> None:
    logs = []
    for n in (1, 3):
        rig = Rig(n=n)
        rig.target[1:, :3] += 0.05
        rig.move((0.02, 0.03, -0.04), 0.1)
        rig.keep(0.2)
        logs.append(np.concatenate([rig.logged(name) for name in ("tool", "estimate", "torque", "command")], axis=1))
    assert logs[0].tobytes() == logs[1].tobytes()


@pytest.mark.thorough
def test_the_example_settles_at_the_force_that_is_asked_for(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["push_wall.py", "--force", "15", "--speed", "0.05", "--hold", "1"])
    runpy.run_path(str(ROOT / "examples" / "push_wall.py"), run_name="__main__")
    last = capsys.readouterr().out.splitlines()[-1]
    assert last.startswith("settled at 1")
    assert abs(float(last.split()[2]) - 15) < 1
