import dataclasses
import math
from collections.abc import Callable

import mujoco
import numpy as np
import pytest

from bhd_lerobot.bodies.arenas import random_arena
from bhd_lerobot.bodies.body import Shape
from bhd_lerobot.bodies.turtlebot3 import turtlebot3_burger
from bhd_lerobot.bodies.ur import ur5
from bhd_lerobot.control.plant import PlantReading
from bhd_lerobot.errors import ConfigError, SimulationError
from bhd_lerobot.sim.plant import SimulatedPlant
from bhd_lerobot.sim.tabletop import Tabletop
from bhd_lerobot.sim.world import World, mujoco_batch
from tests.cases import each_case

BODY = turtlebot3_burger()
RADIUS, SEPARATION = 0.033, 0.160
PHYSICS_HZ = pytest.mark.parametrize("physics_hz", [200, 1000])


def wheel_speeds(speed: float, yaw_rate: float) -> tuple[float, float]:
    """Of a base that rolls without slip, left and right."""
    turn = yaw_rate * SEPARATION / 2
    return (speed - turn) / RADIUS, (speed + turn) / RADIUS


def pass_time(world: World, seconds: float) -> None:
    world.step(round(seconds * world.physics_hz))


def drive(world: World, speed: float, yaw_rate: float, seconds: float, start: tuple[float, float] = (0, 0)) -> None:
    """Take all robots from one twist to another within the body's acceleration limits, and keep it."""
    limit = np.array(BODY.limits.acceleration) / 200
    twist = np.array(start, float)
    for _ in range(round(seconds * 200)):
        twist += np.clip(np.array([speed, yaw_rate]) - twist, -limit, limit)
        world.ctrl[:] = wheel_speeds(*twist)
        world.step(world.physics_hz // 200)


def roam(world: World, sims: range, steps: int = 25) -> None:
    """Drive each simulation by random wheel speeds of its own."""
    generators = [np.random.default_rng([99, sim]) for sim in sims]
    for _ in range(steps):
        for row, generator in enumerate(generators):
            world.ctrl[row] = generator.uniform(-7, 7, 2)
        world.step(8)


def fill(world: World, sims: range) -> None:
    arenas = [random_arena(sim) for sim in sims]
    world.place([arena.shapes for arena in arenas])
    world.reset(poses=np.array([arena.start for arena in arenas]))


def everything(world: World, sim: int) -> bytes:
    """All of one simulation that anybody can see, as bytes."""
    snapshot = world.snapshot(np.array([sim]))
    sensors = [world.sensor(world.model.sensor(k).name)[sim] for k in range(world.model.nsensor)]
    parts = [snapshot.state, *snapshot.fields.values(), *sensors]
    return b"".join(np.ascontiguousarray(part).tobytes() for part in parts)


@pytest.fixture(scope="module")
def many() -> list[bytes]:
    world = World(BODY, 32, threads=2)
    fill(world, range(32))
    roam(world, range(32))
    return [everything(world, sim) for sim in range(32)]


@each_case(("sims", "threads"), [(1, None), (7, 1), (32, 5), ((20, 23), None)])
def test_the_same_commands_give_the_same_bytes_for_any_number_of_simulations_and_threads(
    sims: int | tuple[int, int], threads: int | None, many: list[bytes]
) -> None:
    assert len(set(many)) == 32
    which = range(sims) if isinstance(sims, int) else range(*sims)
    world = World(BODY, len(which), threads=threads)
    fill(world, which)
    roam(world, which)
    assert [everything(world, sim) for sim in range(len(which))] == many[which.start : which.stop]


def test_an_episode_does_not_depend_on_the_one_before(many: list[bytes]) -> None:
    world = World(BODY, 4)
    fill(world, range(40, 44))
    roam(world, range(40, 44), 7)
    fill(world, range(4))
    roam(world, range(4))
    states = [world.snapshot(np.array([sim])).state.tobytes() for sim in range(4)]
    assert all(expected.startswith(state) for state, expected in zip(states, many, strict=False))


def test_only_the_simulations_named_are_stepped() -> None:
    world, reference = World(BODY, 5), World(BODY, 5)
    for each in (world, reference):
        fill(each, range(5))
        each.ctrl[:] = 4.0
    before = [everything(world, sim) for sim in range(5)]
    world.step(10, np.array([1, 4]))
    for steps in (1, 4, 5):  # in as many steps
        reference.step(steps)
    for sim in range(5):
        assert everything(world, sim) == (everything(reference, sim) if sim in (1, 4) else before[sim])
    world.step(10, np.array([], np.intp))
    world.step(10, np.zeros(5, np.bool_))
    world.reset([], np.zeros((0, 3)))
    assert everything(world, 0) == before[0]
    world.step(10, np.array([True, False, True, True, False]))
    assert [everything(world, sim) for sim in range(5)] == [everything(reference, sim) for sim in range(5)]


def test_reset_of_some_leaves_the_others_alone() -> None:
    world = World(BODY, 6)
    fill(world, range(6))
    roam(world, range(6))
    before = [everything(world, sim) for sim in range(6)]
    ids = np.array([0, 3])
    world.place([random_arena(77).shapes, ()], ids)
    world.reset(ids, np.array([(0.1, 0.2, 0.3), (-0.1, 0.0, 3.0)]))
    after = [everything(world, sim) for sim in range(6)]
    assert [a == b for a, b in zip(after, before, strict=True)] == [False, True, True, False, True, True]
    np.testing.assert_allclose(world.base_pose[ids], [(0.1, 0.2, 0.3), (-0.1, 0.0, 3.0)], atol=1e-12)
    assert (world.qvel[ids] == 0).all()
    assert (world.ctrl[ids] == 0).all()
    assert (world.time[ids] == 0).all()


@pytest.mark.law
def test_a_restored_snapshot_goes_on_bit_exactly() -> None:
    world = World(BODY, 5)
    fill(world, range(5))
    roam(world, range(5))
    snapshot = world.snapshot()
    roam(world, range(5), 10)
    expected = [everything(world, sim) for sim in range(5)]
    world.place([()] * 5)
    roam(world, range(3, 8), 4)
    world.restore(snapshot)
    assert world.snapshot().state.tobytes() == snapshot.state.tobytes()
    np.testing.assert_array_equal(world.sensor("encoder_left")[:, 0], world.qpos[:, 7])  # sensors read it at once
    roam(world, range(5), 10)
    assert [everything(world, sim) for sim in range(5)] == expected

    elsewhere = World(BODY, 5, threads=1)
    elsewhere.restore(snapshot)
    roam(elsewhere, range(5), 10)
    assert [everything(elsewhere, sim) for sim in range(5)] == expected


def test_a_snapshot_of_some_can_be_restored_into_others() -> None:
    world = World(BODY, 4)
    fill(world, range(4))
    roam(world, range(4))
    snapshot = world.snapshot([1, 3])
    untouched = everything(world, 3)
    world.restore(snapshot, np.array([0, 2]))
    assert everything(world, 3) == untouched
    for _ in range(3):
        world.ctrl[:] = (6.0, 2.0)
        world.step(20)
    assert everything(world, 0) == everything(world, 1)
    assert everything(world, 2) == everything(world, 3)


def test_a_snapshot_holds_randomised_model_fields_and_undoes_those_that_came_later() -> None:
    world, fresh = World(BODY, 3), World(BODY, 3)
    for each in (world, fresh):
        fill(each, range(3))
    before = world.snapshot()
    world.model_field("geom_friction")[:, :, 0] *= np.array([0.2, 0.5, 1.0])[:, None]
    world.model_field("body_mass")[:] *= np.array([0.7, 1.0, 1.6])[:, None]
    world.model_field("opt.gravity")[:, 2] = (-9.0, -9.81, -10.0)
    world.update_constants()
    roam(world, range(3))
    snapshot = world.snapshot()
    roam(world, range(3), 10)
    expected = [world.snapshot([sim]).state.tobytes() for sim in range(3)]
    world.model_field("geom_friction")[:] = 9.0  # the snapshot is a copy
    for target in (world, World(BODY, 3)):
        target.restore(snapshot)
        roam(target, range(3), 10)
        assert [target.snapshot([sim]).state.tobytes() for sim in range(3)] == expected
    world.restore(before)
    for each in (world, fresh):
        roam(each, range(3))
    assert world.snapshot().state.tobytes() == fresh.snapshot().state.tobytes()


POST = Shape("cylinder", 1.0, 0.0, 0.0, 0.1, 0.1)
APART = BODY.mjcf.replace(
    '<velocity name="wheel_right"', '<velocity name="extra" joint="wheel_left"/><velocity name="wheel_right"'
)


@each_case(
    ("call", "message"),
    [
        (lambda: World(BODY).sensor("imu_gyr"), r"Did you mean 'imu_gyro'.*Valid: .*touch"),
        (lambda: World(BODY).model_field("geom_frictions"), "Did you mean 'geom_friction'"),
        (lambda: World(BODY).joint_slice(["wheel_lef"]), "Did you mean 'wheel_left'"),
        (lambda: World(BODY).joint_slice(["wheel_right", "wheel_left"]), "neighbours"),
        (lambda: World(dataclasses.replace(BODY, mjcf="<mujoco><body/></mujoco>")), BODY.name),
        (lambda: SimulatedPlant(World(dataclasses.replace(BODY, mjcf=APART))), "not neighbours"),
        (lambda: World(BODY, fixtures=(POST,)), "Fixtures"),
        (lambda: World(BODY, 0), "at least one"),
        (lambda: World(BODY, -1), "at least one"),
        (lambda: World(BODY, pool_size=3).place([[POST] * 4]), r"4 obstacles; this world holds 3.*pool_size"),
        (lambda: World(BODY, pool_size=0).place([[POST]]), "1 obstacles; this world holds 0"),
        (lambda: World(BODY).place([[POST], [POST]]), "2 scenes were given for 1"),
        (lambda: World(BODY).reset(poses=np.zeros((2, 3))), "Start poses"),
        (lambda: World(BODY).reset(poses=np.zeros(3)), "Start poses"),
        (lambda: World(BODY).reset(poses=np.array([[0.0, math.nan, 0.0]])), "Start poses"),
        (lambda: World(BODY, 3).restore(World(BODY, 2).snapshot()), "shape"),
    ],
)
def test_what_cannot_be_is_an_error_that_says_so(call: Callable[[], object], message: str) -> None:
    with pytest.raises((SimulationError, ConfigError), match=message):
        call()


def test_sensor_readings_are_live_and_cannot_be_written_to() -> None:
    world = World(BODY)
    encoder = world.sensor("encoder_left")
    world.ctrl[:] = 3.0
    world.step(50)
    assert encoder[0, 0] > 0.1
    with pytest.raises(ValueError, match="read-only"):
        encoder[:] = 0.0


def test_the_plant_reads_and_writes_the_wheels_by_name() -> None:
    world = World(BODY, 3)
    plant = SimulatedPlant(world)
    plant.write(np.array([(0.5, 1.0), (1.0, 1.5), (1.5, 2.0)]))
    pass_time(world, 2.0)

    reading = PlantReading(3, 2)
    plant.read(reading)
    np.testing.assert_allclose(reading.velocity, [(0.5, 1.0), (1.0, 1.5), (1.5, 2.0)], rtol=0.02)
    np.testing.assert_allclose(reading.position, reading.velocity * 2.0, rtol=0.03)
    world.forward()
    for side, name in enumerate(("left", "right")):
        np.testing.assert_array_equal(reading.velocity[:, side], world.sensor(f"speed_{name}")[:, 0])
        np.testing.assert_array_equal(reading.position[:, side], world.sensor(f"encoder_{name}")[:, 0])


@PHYSICS_HZ
@each_case("speed", [0.05, -0.22])
def test_driving_straight_covers_speed_times_time(speed: float, physics_hz: int) -> None:
    world = World(BODY, physics_hz=physics_hz)
    world.reset(poses=np.array([[0.0, 0.0, 0.5]]))
    drive(world, speed, 0.0, 4.0)
    x, y, yaw = world.base_pose[0]
    ramp = abs(speed) / BODY.limits.acceleration[0]
    assert x * math.cos(0.5) + y * math.sin(0.5) == pytest.approx(speed * (4.0 - ramp / 2), rel=0.01)
    assert abs(y * math.cos(0.5) - x * math.sin(0.5)) < 0.002
    assert yaw == pytest.approx(0.5, abs=0.005)


@PHYSICS_HZ
@each_case("rate", [0.5, -2.84])
def test_spinning_turns_rate_times_time_on_the_spot(rate: float, physics_hz: int) -> None:
    world = World(BODY, physics_hz=physics_hz)
    drive(world, 0.0, rate, 1.0)
    turned, before = 0.0, world.base_pose[0, 2]
    for _ in range(200):
        pass_time(world, 0.02)
        yaw = world.base_pose[0, 2]
        turned += (yaw - before + np.pi) % (2 * np.pi) - np.pi
        before = yaw
    assert turned == pytest.approx(rate * 4.0, rel=0.02)
    assert np.hypot(*world.base_pose[0, :2]) < 0.01


def test_the_gyro_measures_the_yaw_rate() -> None:
    world = World(BODY)
    drive(world, 0.1, 1.5, 1.0)
    assert world.sensor("imu_gyro")[0, 2] == pytest.approx(1.5, rel=0.03)
    # At rest the accelerometer feels the floor push against gravity.
    drive(world, 0.0, 0.0, 1.0, (0.1, 1.5))
    pass_time(world, 1.0)
    np.testing.assert_allclose(world.sensor("imu_accelerometer")[0], (0, 0, 9.81), atol=0.1)


def test_a_robot_at_rest_stays_at_rest() -> None:
    world = World(BODY, 2)
    start = np.array([(0.0, 0.0, 0.0), (1.0, -2.0, 2.0)])
    world.reset(poses=start)
    lowest = []
    for _ in range(3):
        world.step(world.physics_hz)
        lowest.append(world.qpos[:, 2].copy())
    drift = world.base_pose - start
    assert np.hypot(drift[:, 0], drift[:, 1]).max() < 1e-3
    assert np.abs(drift[:, 2]).max() < 1e-3
    assert np.abs(lowest).max() < 1e-3  # neither sinks nor lifts off
    tilt = np.abs(world.qpos[:, 4:6]).max() * 2
    assert tilt < math.radians(0.5)


@PHYSICS_HZ
def test_the_robot_keeps_its_feet_on_the_floor_when_it_starts_and_brakes(physics_hz: int) -> None:
    """A robot that rears up by 0.05 rad sees the floor 3.6 m ahead."""
    world = World(BODY, physics_hz=physics_hz)
    largest = 0.0
    speed = 0.0
    for target in (0.22, 0.0, -0.22, 0.22, 0.0):
        for _ in range(100):
            speed += float(np.clip(target - speed, -2.5 / 200, 2.5 / 200))
            world.ctrl[0] = wheel_speeds(speed, 0.0)
            world.step(physics_hz // 200)
            largest = max(largest, 2 * abs(world.qpos[0, 5]))
    assert largest < 0.01


def test_touch_is_felt_at_a_box_and_not_on_the_floor() -> None:
    world = World(BODY, 3)
    low = Shape("box", 0.3, 0.08, 0.0, 0.05, 0.05, 0.05)  # it meets a wheel
    world.place([[Shape("box", 0.3, 0.0, 0.0, 0.05, 0.3)], [], [low]])
    world.reset()
    touch = world.sensor(BODY.drive.touch_sensor)
    drive(world, 0.2, 0.0, 0.8)
    assert not touch.any()
    felt = np.zeros(3, np.bool_)
    while world.time[0] < 2.0:
        world.step()
        # The front of the hull is 0.038 m ahead of the axis, that of the box 0.25 m.
        if not felt[0] and touch[0, 0]:
            assert world.base_pose[0, 0] == pytest.approx(0.25 - 0.038, abs=0.003)
        felt |= touch[:, 0] > 0
    assert felt.tolist() == [True, False, True]
    assert world.base_pose[0, 0] < 0.25 - 0.03  # the box did not let it through
    assert world.base_pose[1, 0] > 0.35


@each_case("broken", [math.nan, math.inf, 1e20])
def test_diverged_physics_is_an_error_that_names_the_simulation(broken: float) -> None:
    world, healthy = World(BODY, 4), World(BODY, 4)
    for each in (world, healthy):
        fill(each, range(4))
        each.ctrl[:] = 3.0
    world.qvel[2, 0] = broken
    world.step(5)
    healthy.step(5)
    with pytest.raises(SimulationError, match=r"simulation\(s\) \[2\] diverged.*physics_hz"):
        world.check()
    assert [everything(world, sim) for sim in (0, 1, 3)] == [everything(healthy, sim) for sim in (0, 1, 3)]
    world.reset([2])
    world.check()
    world.step(5)
    world.check()


TOOL = '<site name="tool" pos="0 0 0.150"'
FIELDS_SINCE_4 = {"site_xquat", "geom_xquat", "xiquat", "plastic"}
"""What `Batch` of MuJoCo 4.0 has and that of 3.17 has not."""


@each_case("turn", ["", ' quat="0.5 0.5 0.5 -0.5"', ' quat="0.1 -0.7 0.3 0.6"'])
def test_the_pose_of_a_site_agrees_with_its_matrix_in_every_supported_mujoco(
    turn: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mujoco_batch, "DATA_FIELDS", frozenset(mujoco_batch.DATA_FIELDS) - FIELDS_SINCE_4)
    arm = ur5()
    assert arm.mjcf.count(TOOL) == 1
    world = World(dataclasses.replace(arm, mjcf=arm.mjcf.replace(TOOL, TOOL + turn)), 3)
    table = Tabletop(world)
    matrices = world.derived("site_xmat")[:, world.model.site("tool").id]
    for seed in range(10):
        world.qpos[:, :6] = np.random.default_rng(seed).uniform(-3, 3, (3, 6))
        world.forward()
        for pose, matrix in zip(table.tool_pose, matrices, strict=True):
            expected = np.empty(9)
            mujoco.mju_quat2Mat(expected, pose[3:])
            np.testing.assert_allclose(expected, matrix, atol=1e-12)
