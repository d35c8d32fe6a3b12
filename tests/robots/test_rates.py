"""A UR5 at other rates than its own: it moves freely without an alarm, and stops where it presses."""

import numpy as np
import pytest

from bhd_lerobot.bodies.body import Shape
from bhd_lerobot.bodies.tabletop import TableScene
from bhd_lerobot.control.commands import BrainCommand, ResultCode
from bhd_lerobot.control.messages import Mode, Watchdog
from bhd_lerobot.robots.config_ur5 import UR5Config
from bhd_lerobot.robots.ur5_simulation import UR5Simulation

# Ticks and physics steps a second.
RATES = ((25, 500), (100, 100), (100, 200), (100, 500), (125, 500), (250, 500), (500, 500), (500, 1000))
BOX = (Shape("box", 0.25, 0.45, 0.0, 0.2, 0.1, 0.8),)
POSTURES, LIGHT_N, MOST_FREE_N = 6, 20.0, 80.0


def start(n: int, control_hz: int, physics_hz: int, fixtures: tuple[Shape, ...] = ()) -> UR5Simulation:
    arm = UR5Simulation(UR5Config(control_hz=control_hz, physics_hz=physics_hz), n, threads=1, fixtures=fixtures)
    arm.reset(np.arange(n), [TableScene("empty", (), arm.body.home)] * n, [0] * n)
    return arm


@pytest.mark.thorough(but=2)
@pytest.mark.parametrize(("control_hz", "physics_hz"), RATES)
def test_at_any_rates_free_goals_succeed_and_press_on_nothing(control_hz: int, physics_hz: int) -> None:
    arm, rng, codes, most = start(POSTURES, control_hz, physics_hz), np.random.default_rng(1), [], 0.0
    for sim in range(POSTURES):
        turn = rng.uniform(-1.0, 1.0, 6) * (1.5, 0.2, 0.4, 1.0, 1.0, 1.0)
        posture = tuple(np.asarray(arm.body.home[:6]) + turn)
        assert arm.controller.submit(sim, BrainCommand("free", joint_target=posture)) is None
    while arm.controller.busy.any():
        report = arm.step(None)
        assert not report.watchdog.any()
        most = max(most, float(arm.controller.force.force.max()))
        codes += [result.code for results in report.results.values() for result in results]
    assert codes == [ResultCode.SUCCEEDED] * POSTURES
    assert most < MOST_FREE_N


@pytest.mark.thorough(but=2)
@pytest.mark.parametrize(("control_hz", "physics_hz"), RATES)
def test_at_any_rates_an_arm_that_presses_on_something_stops(control_hz: int, physics_hz: int) -> None:
    arm = start(1, control_hz, physics_hz, BOX)
    felt, action = arm.world.sensor("force_fixture_0")[0], arm.cerebellum.command.copy()
    touched = False
    for _ in range(60):
        action[0, 0] += 0.3 / arm.rates.fps
        report = arm.step(action)
        touched |= bool(felt.any())
        if report.watchdog[0]:
            break
    assert touched
    assert report.watchdog[0] & Watchdog.FORCE
    assert report.mode[0] == Mode.FAULT
    for _ in range(20):
        arm.step(None)
    assert np.linalg.norm(felt) < LIGHT_N
