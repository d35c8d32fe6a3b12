"""What a base does that is told to drive into things, in a simulated world and with scans that fail."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from bhd_lerobot.bodies.arenas import make_arena
from bhd_lerobot.control.collision_monitor import MARGIN, new_monitors
from bhd_lerobot.control.drive import BaseController
from bhd_lerobot.control.messages import Limit, Mode
from bhd_lerobot.robots.config_turtlebot3 import TurtleBot3Config
from bhd_lerobot.robots.host.simulation import Simulation
from tests.control import support
from tests.control.test_wire import base_rig

Array = NDArray[np.float64]
Stream = Callable[[int, Array, np.random.Generator], Array]

N, FPS, BEAMS = 16, 10, 36
LIDAR = support.BODY.lidar
assert LIDAR is not None
WHEEL_RADIUS = support.BODY.drive.wheel_radius
SCAN_TICKS = support.HZ // LIDAR.rate_hz


def straight(frame: int, last: Array, rng: np.random.Generator) -> Array:
    return np.tile([0.22, 0.0], (N, 1))


def backward(frame: int, last: Array, rng: np.random.Generator) -> Array:
    return np.tile([-0.22, 0.1], (N, 1))


def circles(frame: int, last: Array, rng: np.random.Generator) -> Array:
    return last if frame % 10 else np.stack([np.full(N, 0.22), rng.uniform(-2.8, 2.8, N)], axis=1)


def anything(frame: int, last: Array, rng: np.random.Generator) -> Array:
    return last if frame % 15 else rng.uniform([-0.3, -2.0], [0.9, 2.0], (N, 2))


def drive(
    stream: Stream, seconds: float, *, monitor: bool, arena: str = "random", enough: int = N + 1
) -> tuple[Array, Array, Array, Array]:
    """Return which robots touched something, the flags that were raised, modes, and the commands of every frame.

    It ends once `enough` robots have touched something.
    """
    simulation = Simulation(TurtleBot3Config(collision_monitor=monitor), N)
    simulation.reset(np.arange(N), [make_arena(arena, seed) for seed in range(N)], list(range(N)))
    rng, action = np.random.default_rng(3), np.zeros((N, 2))
    touched, limits, applied = np.zeros(N, np.bool_), np.zeros(N, np.int64), []
    for frame in range(round(seconds * FPS)):
        action = stream(frame, action, rng)
        simulation.observe()
        report = simulation.step(action)
        touched |= simulation.truth().touched
        limits |= report.limits
        applied.append(report.applied)
        if touched.sum() >= enough:
            break
    return touched, limits, report.mode, np.array(applied)


@pytest.mark.thorough(but=1)
@pytest.mark.parametrize(("stream", "seconds"), [(straight, 5.0), (backward, 6.0), (circles, 10.0), (anything, 15.0)])
def test_whoever_commands_it_a_base_touches_nothing(stream: Stream, seconds: float) -> None:
    touched, *_ = drive(stream, seconds, monitor=False, enough=3)
    assert touched.sum() >= 3  # without the monitor
    touched, limits, mode, applied = drive(stream, seconds, monitor=True)
    assert not touched.any()
    assert (mode == Mode.TRACKING).all()
    assert ((limits & Limit.CLEARANCE) != 0).sum() >= 3  # it is told
    assert np.abs(applied[-50:]).max() > 0.0


def test_in_free_space_it_changes_nothing() -> None:
    one, other = (drive(anything, 5.0, monitor=monitor, arena="empty") for monitor in (False, True))
    assert np.array_equal(one[3], other[3])
    assert not (other[1] & Limit.CLEARANCE).any()


def watched(n: int = 1) -> support.Rig:
    """Return bases that drive by what a test writes into the scans."""
    rig = base_rig(n)
    monitors = new_monitors(support.BODY.drive, LIDAR, n, support.HZ, BEAMS)
    controller = BaseController(support.BODY.drive, n, support.HZ, monitors=monitors)
    rig.start(support.BODY, rig.plant, controller, active=True, hz=support.HZ, sensors=BEAMS)
    return rig


def scan(rig: support.Rig, ranges: Array | float) -> None:
    rig.cerebellum.reading.sensors[:] = ranges
    rig.cerebellum.reading.sensors_ns[:] = rig.now


@pytest.mark.law
def test_without_scans_of_the_last_three_periods_it_stands_and_goes_on_with_the_next() -> None:
    for bad in (None, np.nan, np.inf):
        rig = watched()
        rig.send(0.2)
        rig.tick(20)
        assert rig.command == [0.0, 0.0]  # there was none yet
        for _ in range(5):
            scan(rig, 3.0)
            rig.send(0.2)
            rig.tick(SCAN_TICKS)
        assert rig.command[0] == pytest.approx(0.2)
        for tick in range(4 * SCAN_TICKS):
            if bad is not None and tick % SCAN_TICKS == 0:
                scan(rig, bad)
            if tick % 20 == 0:
                rig.send(0.2)
            rig.tick()
            if tick < 2 * SCAN_TICKS - 1:
                assert rig.command[0] == pytest.approx(0.2)
        assert rig.command == [0.0, 0.0]
        assert rig.mode == Mode.TRACKING
        scan(rig, 3.0)
        rig.send(0.2)
        rig.tick(SCAN_TICKS)
        assert rig.command[0] == pytest.approx(0.2, abs=0.005)


def stamped(slack_ns: int = 0) -> support.Rig:
    """Return a watched base whose readings have stamps, which may be so far off."""
    rig = watched()
    read, origin = rig.plant.read, 10**12

    def read_with_stamps(out: Any) -> None:
        read(out)
        out.stamp_ns = np.array([origin + rig.now])

    rig.plant.read = read_with_stamps
    rig.cerebellum.stamp_origin_ns = origin
    if slack_ns:
        rig.cerebellum.readings.accept_until(slack_ns, slack_ns)
    return rig


def scan_of(rig: support.Rig, late: float) -> None:
    scan(rig, 3.0)
    rig.cerebellum.reading.sensors_ns += rig.cerebellum.stamp_origin_ns - round(late * 1e9)


def test_scans_that_come_too_late_or_from_the_future_are_none_of_the_present() -> None:
    for late, moves in ((0.4, True), (0.7, False), (-0.02, False), (-10.0, False)):
        rig = stamped()
        for _ in range(5):
            scan_of(rig, late)
            rig.send(0.2)
            rig.tick(20)
        assert rig.mode == (Mode.TRACKING if late > 0 else Mode.FAULT)
        assert (rig.command[0] > 0.1) == moves


def test_a_scan_from_the_future_does_not_take_the_place_of_one_that_grows_old() -> None:
    rig = stamped(slack_ns=20 * support.NANOSECONDS)
    for tick in range(4 * SCAN_TICKS):
        scan_of(rig, -10.0 if tick else 0.0)
        rig.send(0.1)
        rig.tick()
        assert bool(rig.cerebellum.take_flags()[0][0] & Limit.CLEARANCE) == (tick > 3 * SCAN_TICKS), tick


def test_beside_an_obstacle_only_what_leads_nearer_is_taken_away() -> None:
    """A wall ahead: neither forward nor a turn that sweeps a corner over it, but back, and a turn on the spot."""
    angle = 2 * np.pi * np.arange(BEAMS) / BEAMS
    with np.errstate(divide="ignore"):
        to_wall = np.where(np.cos(angle) > 0, (0.06 + 0.038 + 0.032) / np.cos(angle), 3.5)
    for sent, wanted in (((0.2, 0.0), "slow"), ((-0.2, 0.0), "all"), ((0.0, 0.1), "all")):
        rig = watched()
        scan(rig, np.clip(to_wall, 0.12, 3.5))
        for _ in range(5):
            rig.send(*sent)
            rig.tick(20)
        if wanted == "all":
            assert rig.command == pytest.approx(sent, abs=1e-3)
        else:
            assert 0 <= rig.command[0] < 0.05
            assert int(rig.cerebellum.take_flags()[0][0]) & Limit.CLEARANCE
            assert rig.plant.position.mean() * 0.033 < 0.06 - MARGIN + 0.001


@pytest.mark.parametrize("wall_speed", [0.0, 0.02, 0.05, 0.1])
def test_a_base_stands_when_a_slow_wall_comes_that_it_is_commanded_to_drive_into(wall_speed: float) -> None:
    """Between two scans a wall of 0.1 m/s comes as near as the margin is wide: faster ones are met on the way."""
    rig = watched()
    angle = 2 * np.pi * np.arange(BEAMS) / BEAMS
    front = max(front for _, front, _ in support.BODY.drive.outline)
    for tick in range(12 * support.HZ):
        x = float(rig.plant.position.mean()) * WHEEL_RADIUS
        ahead = 1.0 - wall_speed * tick / support.HZ - x
        if ahead <= front:
            break
        if tick % SCAN_TICKS == 0:
            ranges = np.where(np.cos(angle) > 1e-3, (ahead - LIDAR.ahead) / np.maximum(np.cos(angle), 1e-3), np.inf)
            scan(rig, np.clip(ranges, LIDAR.range_min, LIDAR.range_max))
        if tick % 20 == 0:
            rig.send(0.22)
        rig.tick()
    assert (ahead <= front) == (wall_speed > 0.0)
    assert np.abs(rig.plant.velocity).max() * WHEEL_RADIUS < 0.01


def test_what_is_near_stays_near_when_odometry_begins_anew() -> None:
    rig = watched()
    for _ in range(10):
        scan(rig, 3.0)
        rig.send(0.2)
        rig.tick(SCAN_TICKS)
    scan(rig, 0.14)
    rig.tick(2)
    controller = rig.cerebellum.controller
    assert controller.odometry()[0, 0] > 0.3
    controller.configure(np.zeros(1, np.intp), rig.cerebellum.reading)
    before = rig.plant.position.mean() * 0.033
    for _ in range(4):
        rig.send(0.2)
        rig.tick(10)
    assert rig.plant.position.mean() * 0.033 - before < 0.03


def test_scans_of_a_mad_lidar_stop_it_but_nothing_jumps_at_the_wire() -> None:
    """The plant of the rig asserts at every write that the wheels' commands change no faster than a stop."""
    rng = np.random.default_rng(0)
    rig = watched(16)
    for tick in range(2000):
        if tick % 7 == 0:
            ranges = rng.uniform(0.0, rng.choice([0.2, 0.5, 4.0]), (16, BEAMS))
            ranges[rng.random((16, BEAMS)) < 0.001] = np.nan
            scan(rig, ranges)
        if tick % 20 == 0:
            values = rng.uniform(-1, 1, (16, 2)) * (0.3, 4.0)
            rig.sequence += 1
            rig.cerebellum.offer(support.Setpoint(rig.sequence, rig.now, values))
        rig.tick()
    assert (rig.cerebellum.mode == Mode.TRACKING).all()
