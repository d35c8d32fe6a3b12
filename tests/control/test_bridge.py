import dataclasses

import numpy as np
import pytest

from bhd_lerobot.bodies.body import Rates
from bhd_lerobot.control.bridge import LockstepBridge
from bhd_lerobot.control.cerebellum import Cerebellum
from bhd_lerobot.control.drive import BaseController
from bhd_lerobot.control.messages import Mode, Reason, Watchdog
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.sim.plant import SimulatedPlant
from bhd_lerobot.sim.world import World
from tests.control.support import BODY, PerfectPlant

RATES = Rates(200, 200, 10)


def perfect(n: int = 1, rates: Rates = RATES, timeout: float = 0.5) -> LockstepBridge:
    limits = dataclasses.replace(BODY.limits, command_timeout_s=timeout)
    body = dataclasses.replace(BODY, drive=dataclasses.replace(BODY.drive, limits=limits))
    controller = BaseController(body.drive, n, rates.control_hz)
    bridge = LockstepBridge(Cerebellum(body, PerfectPlant(n), rates.control_hz, controller), rates, lambda: None)
    bridge.restart(np.arange(n))
    return bridge


def simulated(n: int, rates: Rates) -> tuple[LockstepBridge, World]:
    world = World(BODY, n, physics_hz=rates.physics_hz)
    controller = BaseController(BODY.drive, n, rates.control_hz)
    cerebellum = Cerebellum(BODY, SimulatedPlant(world), rates.control_hz, controller)
    bridge = LockstepBridge(cerebellum, rates, lambda: world.step(rates.steps_per_tick))
    bridge.restart(np.arange(n))
    return bridge, world


def twist(*values: float) -> np.ndarray:
    return np.array([values])


@pytest.mark.parametrize("rates", [Rates(400, 200, 10), Rates(600, 300, 30), Rates(70, 7, 7)])
def test_a_frame_is_a_frame_without_drift(rates: Rates) -> None:
    bridge = perfect(rates=rates)
    for frame in range(1, 200):
        bridge.send(twist(0.1, 0.0))
        bridge.advance_frame()
        assert bridge.now_ns == frame * rates.ticks_per_frame * 1_000_000_000 // rates.control_hz
    assert bridge.now_ns * rates.fps // 199 <= 1_000_000_000


def test_frames_as_long_as_the_time_out_do_not_time_out() -> None:
    bridge = perfect(rates=Rates(200, 200, 2))
    for _ in range(5):
        assert bridge.send(twist(0.1, 0.0)).accepted.all()
        bridge.advance_frame()
        assert bridge.state().mode.tolist() == [Mode.TRACKING]
        assert bridge.cerebellum.take_flags()[1].tolist() == [Watchdog.NONE]
    bridge.advance_frame()
    assert bridge.cerebellum.take_flags()[1].tolist() == [Watchdog.COMMAND_AGE]


def test_a_frame_longer_than_the_time_out_is_an_error_that_says_how_fast_is_enough() -> None:
    with pytest.raises(ConfigError, match=r"fps = 4 .*time-out of 0.2 s. Raise fps to at least 5\."):
        perfect(rates=Rates(200, 200, 4), timeout=0.2)
    perfect(rates=Rates(200, 200, 5), timeout=0.2)
    with pytest.raises(ConfigError, match=r"200.*100"):  # a cerebellum of another rate
        LockstepBridge(Cerebellum(BODY, PerfectPlant(), 100, BaseController(BODY.drive, 1, 100)), RATES, lambda: None)


@pytest.mark.law
def test_a_setpoint_takes_the_place_of_what_is_left_of_a_chunk() -> None:
    """A person takes over from a policy that has sent what it wants to do in the coming second."""
    bridge = perfect()
    assert all(result.accepted.all() for result in bridge.send_chunk(np.tile(twist(0.2, 0.5), (10, 1, 1))))
    bridge.advance_frame()
    for _ in range(6):
        assert bridge.send(twist(0.0, 0.0)).accepted.all()
        bridge.advance_frame()
    assert not bridge.cerebellum.plant.written.any()


@pytest.mark.parametrize("rates", [Rates(200, 200, 10), Rates(1000, 200, 10)], ids=str)
def test_an_emergency_stop_brings_bases_to_rest_within_300_ms(rates: Rates) -> None:
    commands = np.array([(0.22, 0.0), (-0.22, 0.0), (0.0, 2.84), (0.0, -2.84), (0.12, 1.2)])
    bridge, world = simulated(len(commands), rates)
    for _ in range(20):
        bridge.send(commands)
        bridge.advance_frame()
    np.testing.assert_allclose(bridge.state().measured, commands, rtol=0.01, atol=0.01)
    np.testing.assert_allclose(np.hypot(*world.qvel[:, :2].T), np.abs(commands[:, 0]), rtol=0.03, atol=0.01)

    written = bridge.cerebellum.controller.actuators.copy()
    bridge.estop()
    bridge.advance_ticks(2)
    # The safe command is out: no wheel is asked to go on as fast.
    after = bridge.cerebellum.controller.actuators
    moving = np.abs(written) > 0.1
    assert (np.abs(after[moving]) < np.abs(written[moving])).all()
    assert (bridge.state().mode == Mode.ESTOP).all()
    bridge.advance_ticks(58)
    start = world.base_pose
    assert not bridge.state().is_moving.any()
    assert np.hypot(*world.qvel[:, :2].T).max() < 0.005
    assert np.abs(world.qvel[:, 5]).max() < 0.02
    for _ in range(20):
        assert (bridge.send(commands).reasons == Reason.ESTOP).all()
        bridge.advance_frame()
    moved = world.base_pose - start
    assert np.hypot(*moved[:, :2].T).max() < 1e-3
    assert np.abs(moved[:, 2]).max() < 5e-3
    assert (bridge.cerebellum.refusals[Reason.ESTOP] == 20).all()
