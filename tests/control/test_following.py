"""Whether the wheels of a base follow their commands, by readings that come late, seldom or not at all."""

from collections import deque

import numpy as np
import pytest
from numpy.typing import NDArray

from bhd_lerobot.control.cerebellum import Cerebellum
from bhd_lerobot.control.drive import BaseController
from bhd_lerobot.control.messages import NANOSECONDS, Mode, Request, Setpoint, Watchdog
from bhd_lerobot.control.plant import Plant, PlantReading
from tests.cases import each_case
from tests.control.support import BODY, HZ, TICK_NS


class LatePlant(Plant):
    """Wheels with dead time and a time constant [s], which are read now and then; see `stop_at`."""

    n = 1

    def __init__(self, latency: float, motor: float, every: int, silent: tuple[float, float]) -> None:
        self._motor, self._every, self._silent = motor, every, silent
        self._speed, self._position, self._late = np.zeros(2), np.zeros(2), deque([np.zeros(2)] * round(latency * HZ))
        self.stamped, self.is_blocked, self._ticks, self._read = True, False, 0, np.zeros((2, 2))
        self._stamp_ns = np.ones(1, np.int64)

    def read(self, out: PlantReading) -> None:
        now = self._ticks / HZ
        is_silent = self._silent[0] and now % self._silent[0] > self._silent[0] - self._silent[1]
        if self._ticks % self._every == 0 and not is_silent:
            self._read[:], self._stamp_ns[0] = (self._position, self._speed), 2 + self._ticks * TICK_NS
        out.position[0], out.velocity[0] = self._read
        out.stamp_ns = self._stamp_ns if self.stamped else None

    def write(self, ctrl: NDArray[np.float64]) -> None:
        self._late.append(ctrl[0].copy())
        wanted = self._late.popleft()
        self._speed = wanted if not self._motor else self._speed + (wanted - self._speed) / HZ / self._motor
        if self.is_blocked:
            self._speed = np.zeros(2)
        self._position = self._position + self._speed / HZ
        self._ticks += 1


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
) -> tuple[float, str]:
    """Return when a base on random commands makes a protective stop [s], infinite for never, and its cause.

    Args:
        latency, motor: of the base: dead time and time constant [s].
        allowed: the latency that the controller knows of [s].
        silent: of each so many seconds, how many nothing is read at the end.
    """
    rng, plant = np.random.default_rng(seed), LatePlant(latency, motor, round(HZ / read_hz), silent)
    plant.stamped = stamped
    controller = BaseController(BODY.drive, 1, HZ, latency_s=allowed)
    cerebellum = Cerebellum(BODY, plant, HZ, controller)
    cerebellum.readings.accept_until(NANOSECONDS, NANOSECONDS)
    assert all(cerebellum.request(request).accepted.all() for request in (Request.CONFIGURE, Request.ACTIVATE))
    twist = np.array([0.2, 0.0])
    for tick in range(round(seconds * HZ)):
        plant.is_blocked = tick / HZ >= blocked_from
        if tick and tick % round(0.4 * HZ) == 0:
            twist = rng.uniform([-0.22, -2.5], [0.22, 2.5])
        if tick % 20 == 0:
            assert cerebellum.offer(Setpoint(tick, tick * TICK_NS, twist[None])).accepted.all()
        cerebellum.tick(tick * TICK_NS)
        if cerebellum.mode[0] != Mode.TRACKING:
            assert cerebellum.mode[0] == Mode.FAULT
            assert cerebellum.take_flags()[1].tolist() == [Watchdog.BLOCKED]
            return tick / HZ, controller.cause
    return np.inf, controller.cause


@each_case(("latency", "motor"), [(0, 0), (0.1, 0.1), (0.2, 0.1), (0.3, 0.0), (0.05, 0.2), (0.2, 0.0)])
@each_case("read_hz", [5, 20, 100])
@pytest.mark.thorough(but=1)
@pytest.mark.parametrize("seed", range(3))
def test_a_base_that_follows_within_its_latency_is_never_blocked(
    latency: float, motor: float, read_hz: float, seed: int
) -> None:
    assert stop_at(10, latency=latency, motor=motor, read_hz=read_hz, seed=seed)[0] == np.inf


@each_case("silence", [0.3, 0.35, 0.4, 0.45])
@each_case("motor", [0.05, 0.1])
@each_case("allowed", [0.0, 0.3])
def test_while_nothing_is_read_nothing_is_blocked(silence: float, motor: float, allowed: float) -> None:
    assert stop_at(15, motor=motor * bool(allowed), allowed=allowed, silent=(1.5, silence))[0] == np.inf


@each_case("allowed", [0.0, 0.1, 0.3, 0.6])
@each_case("stamped", [True, False])
def test_wheels_that_stand_are_found_after_the_latency(allowed: float, stamped: bool) -> None:
    """From the first command on, which is 6 rad/s for 0.4 s; its ramp takes 0.1 s."""
    at, cause = stop_at(5, allowed=allowed, blocked_from=0.0, stamped=stamped, read_hz=HZ)
    if allowed < 0.1:  # later commands are others, and may change sign
        assert 0.3 <= at < 0.45
    assert at < np.inf
    assert "have not turned at all" in cause
    assert (f"of which {allowed:g} s are its latency" in cause) == bool(allowed)


def test_wheels_that_are_blocked_later_are_named_otherwise() -> None:
    at, cause = stop_at(20, allowed=0.1, blocked_from=3.0)
    assert 3.0 < at < 10.0
    assert "Something blocks one" in cause
