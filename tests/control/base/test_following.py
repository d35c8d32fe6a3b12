"""Whether the wheels of a base follow their commands, by readings that come late, seldom or not at all."""

from collections import deque

import numpy as np
import pytest

from bhd_lerobot.bodies.turtlebot3 import turtlebot3_burger
from bhd_lerobot.control.drive import BaseController
from bhd_lerobot.control.messages import Watchdog
from bhd_lerobot.control.plant import PlantReading
from tests.cases import each_case

HZ, SECOND = 200, 1_000_000_000


def stop_at(
    seconds: float,
    *,
    latency: float = 0.0,
    motor: float = 0.0,
    allowed: float = 0.3,
    read_hz: float = 20.0,
    silent: tuple[float, float] = (0.0, 0.0),
    blocked_from: float = np.inf,
    stamped: bool = True,
    seed: int = 0,
) -> tuple[float, BaseController]:
    """Return when a base on random commands makes a protective stop [s], infinite for never, and its controller.

    Args:
        latency, motor: of the base: dead time and time constant [s].
        allowed: the latency that the controller knows of [s].
        silent: of each so many seconds, how many nothing is read at the end.
    """
    rng = np.random.default_rng(seed)
    controller = BaseController(turtlebot3_burger().drive, 1, HZ, latency_s=allowed)
    out = PlantReading(1, 2, 0)
    out.stamp_ns = np.ones(1, np.int64) if stamped else None
    controller.configure(np.array([0]), out)
    speed, position, late = np.zeros(2), np.zeros(2), deque([np.zeros(2)] * (1 + round(latency * HZ)))
    everyone = np.ones(1, np.bool_)
    for tick in range(round(seconds * HZ)):
        now = tick / HZ
        if tick % round(0.4 * HZ) == 0:
            twist = rng.uniform([-0.22, -2.5], [0.22, 2.5]) if tick else np.array([0.2, 0.0])
            controller.set_setpoint(twist[None], everyone)
        late.append(controller.actuators[0].copy())
        wanted = late.popleft()
        speed = wanted if not motor else speed + (wanted - speed) / HZ / motor
        if now >= blocked_from:
            speed = np.zeros(2)
        position = position + speed / HZ
        is_silent = silent[0] and now % silent[0] > silent[0] - silent[1]
        if tick % round(HZ / read_hz) == 0 and not is_silent:
            out.position[0], out.velocity[0] = position, speed
            if out.stamp_ns is not None:
                out.stamp_ns[0] = 2 + round(now * SECOND)
        controller.run(out)
        if controller.protective_stop[0]:
            assert controller.protective_stop[0] == Watchdog.BLOCKED
            return now, controller
    return np.inf, controller


@each_case(("latency", "motor"), [(0, 0), (0.1, 0.1), (0.2, 0.1), (0.3, 0.0), (0.05, 0.2), (0.2, 0.0)])
@each_case("read_hz", [5, 20, 100])
@pytest.mark.thorough(but=1)
@pytest.mark.parametrize("seed", range(3))
def test_a_base_that_follows_within_its_latency_is_never_blocked(
    latency: float, motor: float, read_hz: float, seed: int
) -> None:
    assert stop_at(20, latency=latency, motor=motor, read_hz=read_hz, seed=seed)[0] == np.inf


@each_case("silence", [0.3, 0.35, 0.4, 0.45])
@each_case("motor", [0.05, 0.1])
@each_case("allowed", [0.0, 0.3])
def test_while_nothing_is_read_nothing_is_blocked(silence: float, motor: float, allowed: float) -> None:
    assert stop_at(15, motor=motor * bool(allowed), allowed=allowed, silent=(1.5, silence))[0] == np.inf


@each_case("allowed", [0.0, 0.1, 0.3, 0.6])
@each_case("stamped", [True, False])
def test_wheels_that_stand_are_found_after_the_latency(allowed: float, stamped: bool) -> None:
    """From the first command on, which is 6 rad/s for 0.4 s; its ramp takes 0.1 s."""
    at, controller = stop_at(5, allowed=allowed, blocked_from=0.0, stamped=stamped, read_hz=HZ)
    if allowed < 0.1:  # later commands are others, and may change sign
        assert 0.3 <= at < 0.45
    assert at < np.inf
    assert "have not turned at all" in controller.cause
    assert (f"of which {allowed:g} s are its latency" in controller.cause) == bool(allowed)


def test_wheels_that_are_blocked_later_are_named_otherwise() -> None:
    at, controller = stop_at(20, allowed=0.1, blocked_from=3.0)
    assert 3.0 < at < 10.0
    assert "Something blocks one" in controller.cause
