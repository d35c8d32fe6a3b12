"""A plant in a process of its own: it follows fresh commands, and stops the robot when there are none.

The loop runs on a virtual clock. Processes are started few times, and what they did is read from their own record, by
laws that hold however late anything was.
"""

import os
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from bhd_lerobot.bodies.arenas import make_arena
from bhd_lerobot.bodies.ur5 import ur5
from bhd_lerobot.control.guard import Guard, WireLimits
from bhd_lerobot.control.messages import NANOSECONDS, Mode, Request, Watchdog
from bhd_lerobot.control.plant import PlantReading
from bhd_lerobot.errors import CommandRefusedError, ConfigError, RealtimeError
from bhd_lerobot.realtime.block import LiveBlock, Word
from bhd_lerobot.realtime.grid import Slot
from bhd_lerobot.realtime.plant_link import CommandGuard, PlantLink, PlantPhase, RemotePlant
from bhd_lerobot.realtime.shared_memory import names
from bhd_lerobot.robots.base_simulation import BaseSimulation
from bhd_lerobot.robots.config_turtlebot3 import TurtleBot3Config
from bhd_lerobot.robots.config_ur5 import UR5Config
from bhd_lerobot.robots.host.config import RealtimeConfig
from bhd_lerobot.robots.host.plant_loop import PlantLoop, PlantTick
from bhd_lerobot.robots.host.plant_process import SensedWorld
from bhd_lerobot.robots.host.plant_stop import ServoStop, WheelStop, make_stop
from bhd_lerobot.robots.host.remote_plant import RemoteSimulation, plant_shape
from bhd_lerobot.robots.host.simulation import Simulation
from bhd_lerobot.robots.host.state import WATCHDOGS
from bhd_lerobot.robots.turtlebot3 import TurtleBot3
from bhd_lerobot.robots.ur5 import UR5
from bhd_lerobot.robots.ur5_simulation import UR5Simulation
from bhd_lerobot.sim.plant import SimulatedPlant
from bhd_lerobot.sim.world import World
from tests.cases import each_case
from tests.realtime.test_plant_link import anything
from tests.waiting import until

HZ = 200
PERIOD = NANOSECONDS // HZ
TIMEOUT = 20_000_000
START = 10 * NANOSECONDS


class FakeWorld:
    """Wheels that slow down by `brake` in a tick when they are commanded to stand, and else turn as commanded."""

    def __init__(self, brake: float = 0.5) -> None:
        self.brake = brake
        self.velocity = 0.0
        self.advanced = 0
        self.wanted: NDArray[np.float64] = np.zeros((1, 2))
        self.ticks: list[tuple[PlantTick, PlantPhase, list[float]]] = []

    def read(self, out: PlantReading) -> None:
        out.velocity[:] = self.velocity

    def write(self, actuators: NDArray[np.float64]) -> None:
        self.wanted = actuators.copy()

    def set_mode(self, mode: NDArray[np.int8]) -> None: ...

    def advance(self) -> None:
        self.advanced += 1
        wanted = float(self.wanted[0, 0])
        self.velocity = wanted if wanted else max(0.0, self.velocity - self.brake)

    def publish(self, tick: PlantTick, reading: PlantReading, guard: CommandGuard) -> None:
        self.ticks.append((tick, guard.phase, tick.actuators[0].tolist()))


class LoopRig:
    """A loop, and on its clock a cerebellum that sends a command every period until it dies."""

    def __init__(self, world: FakeWorld, dies_ns: int, happens: dict[int, Any] | None = None) -> None:
        shape = plant_shape(SIMULATIONS["turtlebot3"]())
        self.link = PlantLink(shape)
        self.now = START - 20_000_000
        self.remote = RemotePlant(self.link, lambda: self.sent)
        self.sent, self.dies = START, dies_ns
        self.words = np.zeros(64, np.int64)
        self.orphan = False
        self.happens = happens or {}
        self.guard = CommandGuard(self.link, TIMEOUT, anything(), NANOSECONDS // HZ)
        self.world = world
        self.loop = PlantLoop(
            world,
            self.guard,
            WheelStop(2),
            self.words,
            joints=2,
            control_hz=HZ,
            most_catch_up=10,
            is_orphan=lambda: self.orphan,
            clock=lambda: self.now,
            sleep=self.sleep,
        )

    def sleep(self, seconds: float) -> None:
        self.now += round(seconds * NANOSECONDS)
        while self.sent <= min(self.now, self.dies):
            self.remote.write(np.full((1, 2), 6.0))
            self.sent += PERIOD
        for when in [happen for happen in self.happens if happen <= self.now]:
            self.happens.pop(when)(self)
        assert self.now < START + 60 * NANOSECONDS, "the loop does not end"


def end(rig: LoopRig) -> None:
    rig.words[Word.END] = rig.words[Word.PAUSE] = 1


def test_it_ticks_half_a_period_after_the_cerebellum_and_waits_for_its_first_command() -> None:
    rig = LoopRig(FakeWorld(), START + 30 * PERIOD, {START + NANOSECONDS: end})
    rig.loop.run(START)
    dues = [tick.slot.due_ns for tick, _, _ in rig.world.ticks]
    assert dues == list(range(dues[0], dues[-1] + 1, PERIOD))
    assert {(due - START) % PERIOD for due in dues} == {PERIOD // 2}
    assert dues[0] < START - 15_000_000
    phases = [phase for tick, phase, _ in rig.world.ticks if tick.slot.due_ns < START]
    assert set(phases) == {PlantPhase.WAITING}
    after = [phase for tick, phase, _ in rig.world.ticks if tick.slot.due_ns > START]
    assert set(after[:30]) == {PlantPhase.DRIVEN}
    assert rig.world.advanced == len(after)  # while it waited the world stood still
    assert rig.words[Word.PLANT_ALIVE] == rig.now
    # Silence stops the wheels within the time-out and a tick.
    last = START + 30 * PERIOD
    stopped = [tick for tick, phase, _ in rig.world.ticks if phase == PlantPhase.STOPPED]
    assert 0 < stopped[0].start_ns - last <= TIMEOUT + PERIOD
    for tick, phase, actuators in rig.world.ticks:
        if tick.slot.due_ns > START:
            assert actuators == ([0.0, 0.0] if phase == PlantPhase.STOPPED else [6.0, 6.0])
    assert rig.guard.stops == 1


@each_case("orphan", [False, True])
def test_a_process_that_is_to_end_sees_its_robot_to_rest_first(orphan: bool) -> None:
    def ask(rig: LoopRig) -> None:
        if orphan:
            rig.orphan = True
        else:
            end(rig)

    rig = LoopRig(FakeWorld(brake=0.1), START + 30 * PERIOD, {START + 29 * PERIOD: ask})
    rig.loop.run(START)
    assert rig.world.velocity < 1e-9
    assert rig.guard.phase == PlantPhase.STOPPED
    assert rig.now - START < 2 * NANOSECONDS
    # One that does not come to rest is left in the end.
    rig = LoopRig(FakeWorld(brake=0.0), START + 30 * PERIOD, {START + 31 * PERIOD: end})
    rig.loop.run(START)
    assert rig.world.velocity == 6.0
    assert 3 * NANOSECONDS < rig.now - START < 5 * NANOSECONDS


@each_case(("away", "skipped", "advanced"), [(2, 1, 2), (3, 2, 3), (31, 30, 11)])
def test_missed_ticks_are_caught_up_within_a_bound(away: int, skipped: int, advanced: int) -> None:
    world = FakeWorld()
    rig = LoopRig(world, START + 1000 * PERIOD, {START + 50 * PERIOD: lambda r: r.words.__setitem__(Word.PAUSE, 1)})
    advance = world.advance

    def late() -> None:
        """Be away for some periods while the fifth tick runs."""
        advance()
        rig.now += away * PERIOD if world.advanced == 5 else 0

    world.advance = late  # type: ignore[method-assign]
    grid = rig.loop.run(START)
    assert grid.skipped == skipped
    ticks = [(tick.slot, phase) for tick, phase, _ in world.ticks if tick.slot.due_ns > START]
    assert ticks[5][0].skipped == skipped
    assert world.advanced == len(ticks) - 1 + advanced
    # Who was away for longer than a command may be old cannot vouch for the robot any more.
    assert ticks[-1][1] == (PlantPhase.STOPPED if away * PERIOD > TIMEOUT else PlantPhase.DRIVEN)


def test_servos_that_hold_the_arm_follow_a_reading_that_runs_away_no_farther_than_a_brake() -> None:
    stop, reading = ServoStop(ur5().arm), PlantReading(1, 7)
    stop.begin(reading.position)
    for _ in range(2000):
        reading.position[:] += 2.0 / 500
        reading.velocity[:] = 2.0  # by which it never comes to rest
        assert (stop.command(reading)[0, :6] < 0.9).all()


def test_a_servo_follows_a_fast_joint_and_holds_a_slow_one() -> None:
    stop, reading = ServoStop(ur5().arm), PlantReading(1, 7)
    last = np.full((1, 7), 0.03)
    stop.begin(last)
    reading.velocity[:] = [[1.0, 0.0, 1.0, 1.0, 1.0, 1.0, 0.1]]
    for position in (0.1, 0.2, 0.3):
        reading.position[:] = position
        assert stop.command(reading).tolist() == [[position, 0.1, *[position] * 4, 0.03]]
    reading.velocity[:] = 0.0
    stop.command(reading)
    reading.position[:], reading.velocity[:] = 0.5, 1.0  # pushed
    assert stop.command(reading).tolist() == [[0.3, 0.1, *[0.3] * 4, 0.03]]
    stop.begin(last)
    assert stop.command(reading).tolist() == [[*[0.5] * 6, 0.03]]  # the next stop begins anew


@pytest.mark.parametrize("actuation", ["position", "torque"])
def test_an_arm_comes_to_rest_and_stays_there_by_itself(actuation: Any) -> None:
    body = ur5(actuation=actuation)
    world = World(body, 1)
    plant, stop, reading = SimulatedPlant(world), make_stop(body, 7), PlantReading(1, 7)
    world.qvel[:, :6] = [1.0, -1.0, 1.5, 2.0, 2.0, -2.0]
    stop.begin(np.asarray(body.arm.home)[None])
    plant.set_mode(np.array([Mode.FAULT], np.int8))
    effort = np.asarray(body.limits.effort)
    speeds, positions = [], []
    for _ in range(1000):
        plant.read(reading)
        command = stop.command(reading)
        assert actuation == "position" or (np.abs(command[0, :6]) <= effort[:6]).all()
        plant.write(command)
        world.step()
        speeds.append(np.abs(reading.velocity[0, :6]).max())
        positions.append(reading.position[0].copy())
    assert max(speeds[250:]) < 0.05  # half a second
    assert speeds[-1] < 0.01
    assert np.abs(positions[-1] - positions[-500]).max() < 1e-3
    assert np.abs(positions[-1][:6] - positions[0][:6]).max() < 0.3  # it braked, and fell nowhere


ARENA = make_arena("random", seed=3)


SIMULATIONS: dict[str, Any] = {
    "turtlebot3": lambda: BaseSimulation(TurtleBot3Config(odometry=True, imu=True), 1, 1),
    "ur5": lambda: UR5Simulation(UR5Config(), 1, 1),
}


class Parts:
    """A cerebellum and a world that know of each other by a link, beside the same robot in one part."""

    def __init__(self, kind: str) -> None:
        self.whole: Simulation = SIMULATIONS[kind]()
        self.now = 0
        there, own = SIMULATIONS[kind](), SIMULATIONS[kind]()
        shape = plant_shape(own)
        link = PlantLink(shape)
        self.remote = RemoteSimulation(own, link)
        self.remote.remote._clock = lambda: self.now
        self.world = SensedWorld(there, link.states, shape.state_dtype, lambda: self.now)
        hz = own.rates.control_hz
        self.guard = CommandGuard(link, TIMEOUT, Guard(WireLimits.of(own.body, hz), 1), NANOSECONDS // hz)
        self.loop = PlantLoop(
            self.world,
            self.guard,
            make_stop(there.body, shape.joints),
            np.zeros(64, np.int64),
            joints=shape.joints,
            control_hz=own.rates.control_hz,
            most_catch_up=10,
            is_orphan=lambda: False,
        )
        self.period = self.loop.period_ns
        self.slot = Slot(0, 0, 0, 0)
        self.sims = [self.whole, self.remote]
        self.scene = ARENA if kind == "turtlebot3" else UR5(UR5Config()).make_scene()
        self.place()

    def place(self) -> None:
        self.world.place(self.scene, 5)
        self.guard.place()
        self.loop.tick(self.slot, self.now)
        for simulation in self.sims:
            simulation.reset(np.zeros(1, np.intp), [self.scene], [5])

    def plant_tick(self) -> None:
        self.now += self.period
        self.loop.tick(self.slot, self.now)

    def hang(self) -> None:
        """Let the plant go on alone until it stops."""
        while self.guard.phase != PlantPhase.STOPPED:
            self.plant_tick()

    def tick(self) -> None:
        for simulation in self.sims:
            simulation.cerebellum.tick(self.now)
        self.plant_tick()
        for simulation in self.sims:
            simulation.advance()


@pytest.mark.parametrize("kind", ["turtlebot3", "ur5"])
def test_a_remote_plant_gives_the_same_states_as_a_local_plant(kind: str) -> None:
    parts = Parts(kind)
    rng = np.random.default_rng(0)
    start = parts.whole.cerebellum.command.copy()
    for tick in range(300):
        if tick % 20 == 0:
            values = start + rng.normal(0.0, 0.05, start.shape)
            for simulation in parts.sims:
                simulation.bridge.send(values, due_ns=parts.now)
        parts.tick()
        (seen, oldest), (remote_seen, remote_oldest) = (simulation.sense() for simulation in parts.sims)
        np.testing.assert_array_equal(remote_seen, seen)
        assert parts.remote.tick - remote_oldest == parts.whole.tick - oldest
    np.testing.assert_array_equal(parts.remote.physics_state, parts.whole.physics_state)
    assert np.abs(seen - start[:, :1]).max() > 0.1
    np.testing.assert_array_equal(
        parts.remote.cerebellum.controller.odometry(), parts.whole.cerebellum.controller.odometry()
    )


def test_touches_reach_the_cerebellums_process_once_each() -> None:
    parts = Parts("turtlebot3")
    there = parts.world.simulation
    for expected in (True, False, True):
        if expected:
            there.touches[0][:] = True
        parts.plant_tick()
        parts.remote.advance()
        assert parts.remote.touches[0].tolist() == [expected]
        parts.remote.touches[0][:] = False
    assert not there.touches[0].any()


def test_after_a_stop_and_a_reset_the_arm_goes_on_from_where_it_is() -> None:
    parts = Parts("ur5")
    cerebellum = parts.remote.cerebellum
    values = cerebellum.command.copy()
    values[0, 0] += 1.0
    values[0, -1] = 0.02
    for tick in range(100):
        if tick % 20 == 0:
            parts.remote.bridge.send(values, due_ns=parts.now)
        parts.tick()
    assert cerebellum.mode[0] == Mode.TRACKING
    parts.hang()

    for _ in range(400):
        parts.tick()
        assert cerebellum.mode[0] == Mode.FAULT
        assert parts.guard.phase == PlantPhase.STOPPED
    opening = cerebellum.command[0, -1]
    before = cerebellum.reading.position.copy()
    assert cerebellum.request(Request.RESET).accepted.all()
    for _ in range(200):
        parts.tick()
    assert parts.guard.phase == PlantPhase.DRIVEN
    assert cerebellum.mode[0] == Mode.INACTIVE
    assert np.abs(cerebellum.reading.position - before)[0, :6].max() < 1e-3  # no jump
    assert cerebellum.command[0, -1] == opening
    parts.hang()
    parts.place()  # a new scene forgets a stop
    for _ in range(5):
        parts.tick()
        assert cerebellum.mode[0] == Mode.HOLD
        assert parts.guard.phase == PlantPhase.DRIVEN


def test_a_time_out_that_cannot_be_is_refused_before_anything_starts() -> None:
    for value in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(ConfigError, match=r"plant_timeout_s is .*must be positive"):
            RealtimeConfig(plant_timeout_s=value)
    assert RealtimeConfig(plant_timeout_s=0.05).limits().plant_timeout_s == 0.05  # and the cerebellum's
    with pytest.raises(ConfigError, match=r"plant_timeout_s is 0.009; at control_hz = 200 .* at least 0.01 s"):
        TurtleBot3(live(TurtleBot3Config, plant_timeout_s=0.009)).connect()
    assert not [name for name in names() if f"test-plant-{os.getpid()}" in name]  # others are of tests beside this one


LONG = 0.2  # [s] time-out of the plant in these tests: other tests may keep all processors busy for longer than 20 ms


def live(kind: Any, plant_timeout_s: float = LONG) -> Any:
    config = kind(id=f"test-plant-{os.getpid()}", clock="realtime")
    config.realtime = RealtimeConfig(plant_process=True, plant_timeout_s=plant_timeout_s, most_misses=1000)
    return config


@contextmanager
def moving(kind: str) -> Iterator[tuple[Any, PlantLink]]:
    """Yield a robot that moves, and what its plant publishes."""
    robot: Any = TurtleBot3(live(TurtleBot3Config)) if kind == "turtlebot3" else UR5(live(UR5Config))
    block = None
    try:
        for attempt in range(5):
            robot.connect()
            block = LiveBlock.attach(robot.host.link.block.name)
            link = PlantLink.of(block)
            assert link is not None
            try:
                _set_in_motion(robot, link, kind)
                break
            except CommandRefusedError:  # on a busy machine its plant or its cerebellum were too late
                assert attempt < 4
                robot.disconnect()
                block.close()
        yield robot, link
    finally:
        robot.disconnect()
        if block is not None:
            block.close()


def _set_in_motion(robot: Any, link: PlantLink, kind: str) -> None:
    names, command = robot.action_names, robot.host.bridge.latest["command"][0].tolist()
    target = {"x.vel": 0.2, "theta.vel": 0.0} if kind == "turtlebot3" else dict(zip(names, command, strict=True))
    state: Any = link.states.latest()
    while np.abs(state["velocity"]).max() < (3.0 if kind == "turtlebot3" else 0.5):
        if kind == "ur5":
            target["shoulder_pan.pos"] += 0.04
        robot.send_action(target)
        time.sleep(0.04)
        state = link.states.latest()


@pytest.mark.thorough(but=1)
@pytest.mark.parametrize("kind", ["turtlebot3", "ur5"])
def test_killing_the_cerebellum_stops_the_robot(kind: str) -> None:
    with moving(kind) as (robot, link):
        live_link = robot.host.link
        timeout, period = round(LONG * NANOSECONDS), NANOSECONDS // robot.host.rates.control_hz
        os.kill(live_link.pids["cerebellum"], signal.SIGKILL)
        last: Any = None
        stopped: Any = None

        def find() -> bool:
            """Find the last tick before the stop and the first of it, before they are overwritten."""
            nonlocal last, stopped
            newest = len(link.states) - 1
            rows = [link.states.copy(number) for number in range(max(0, newest - link.shape.capacity + 2), newest + 1)]
            for row in (row for row in rows if row is not None):
                if row["phase"] == PlantPhase.DRIVEN:
                    last = row
                elif row["phase"] == PlantPhase.STOPPED and stopped is None:
                    stopped = row
            return stopped is not None

        until(find)
        # The first tick on the plant's grid at which the last command was too old.
        assert last["command"] == stopped["command"]
        assert last["start_ns"] - last["command_ns"] <= timeout < stopped["start_ns"] - stopped["command_ns"]
        ticks = stopped["index"] - last["index"]
        assert stopped["due_ns"] - stopped["command_ns"] <= timeout + ticks * period
        assert (stopped["phase"], stopped["stops"], stopped["stopped_ns"]) == (2, 1, stopped["start_ns"])
        if kind == "turtlebot3":
            assert not stopped["actuators"].any()

        until(lambda: np.abs(link.states.latest()["velocity"]).max() < 0.01)  # type: ignore[index]
        until(lambda: live_link._processes["cerebellum"].poll() is not None)
        with pytest.raises(RealtimeError, match=r"cerebellum's process was killed by signal 9. The plant stops"):
            live_link.check()
        block_name, plant = live_link.block.name, live_link._processes["plant"]
    assert plant.returncode == 0  # it ended in order
    assert block_name not in names()


def test_a_stopped_cerebellum_goes_on_after_a_reset_and_a_stopped_or_killed_plant_is_a_fault_and_an_error() -> None:
    with moving("turtlebot3") as (robot, link):
        pid = robot.host.link.pids["cerebellum"]
        os.kill(pid, signal.SIGSTOP)
        until(lambda: link.states.latest()["phase"] == PlantPhase.STOPPED)  # type: ignore[index]
        until(lambda: np.abs(link.states.latest()["velocity"]).max() < 0.01)  # type: ignore[index]
        os.kill(pid, signal.SIGCONT)
        until(lambda: robot.host.modes[0] == Mode.FAULT)
        assert link.states.latest()["phase"] == PlantPhase.STOPPED  # type: ignore[index]
        bridge = robot.host.bridge
        until(lambda: bool(bridge.reset().accepted.all()))
        until(lambda: link.states.latest()["phase"] == PlantPhase.DRIVEN)  # type: ignore[index]
        robot.activate()
        robot.send_action({"x.vel": 0.1, "theta.vel": 0.0})
        assert link.states.latest()["stops"] == 1  # type: ignore[index]

        live_link, seen = robot.host.link, WATCHDOGS.index(Watchdog.PLANT)
        until(lambda: robot.host.modes[0] == Mode.TRACKING)
        before = int(bridge.latest["watchdogs"][seen])
        os.kill(live_link.pids["plant"], signal.SIGSTOP)
        until(lambda: robot.host.modes[0] == Mode.FAULT)
        until(lambda: bridge.latest["watchdogs"][seen] > before)
        with pytest.raises(RealtimeError, match=r"plant's process \(\d+\) has shown no sign of life for 2\.\d s"):
            until(live_link.check)  # it says nothing until then
        os.kill(live_link.pids["plant"], signal.SIGKILL)
        until(lambda: live_link._processes["plant"].poll() is not None)
        with pytest.raises(RealtimeError, match=r"plant's process was killed by signal 9. The cerebellum is in FAULT"):
            live_link.check()
        block_name = live_link.block.name
    assert block_name not in names()


@pytest.mark.thorough
def test_a_base_on_the_wall_clock_stops_before_a_wall_that_its_plant_sees() -> None:
    """The scan comes from another process. On a busy machine it comes late, and the base is slower for it."""
    config = live(TurtleBot3Config)
    config.arena, config.collision_monitor, config.command_timeout_s = "turtlebot3_world", True, 20.0
    speeds: list[float] = []

    def stands() -> bool:
        speeds.append(robot.send_action({"x.vel": -0.22, "theta.vel": 0.0})["x.vel"])
        return min(speeds) < -0.2 and speeds[-1] > -0.01

    with TurtleBot3(config) as robot:
        until(stands, "it stands before a wall")
        simulation: Any = robot.host
        assert not simulation.truth().touched.any()
        assert int(simulation.modes[0]) == Mode.TRACKING
        assert robot.get_observation()["scan_180.pos"] < 0.25
