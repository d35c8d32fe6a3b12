"""Faults that are put into running robots on purpose, and what the robots do then."""

import os
import random
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from benchmarks.realtime.cases import CaseError
from benchmarks.realtime.owner import OwnerSpec
from benchmarks.realtime.robots import OwnedRobot, standing_still
from benchmarks.realtime.stamps import Loss, Stop, judge_loss, judge_stop, reference_speed
from bhd_lerobot.control.fifo import RingReader
from bhd_lerobot.control.messages import NANOSECONDS, Mode
from bhd_lerobot.realtime.block import Word
from bhd_lerobot.realtime.frame_log import FrameLog
from bhd_lerobot.realtime.plant_link import PlantLink, PlantPhase

_MOVING = {"ur5": 1e-4, "turtlebot3": 0.1}  # reference speed from which a press counts [rad a tick; m/s and rad/s]
_PRESS_NS = 50_000  # a press that took longer was interrupted: nobody knows when the word was set
_BRAIN_TIMEOUT_S = 0.5
_PATIENCE_S = 10.0


@dataclass
class Stops:
    """What emergency stops of one robot did.

    Attributes:
        stops: one for each.
        unsure: presses that were repeated because nobody knows exactly when they happened.
    """

    stops: list[Stop] = field(default_factory=list)
    unsure: int = 0


def press_stops(robot: OwnedRobot, count: int, stops: Stops, rng: random.Random) -> None:
    """Press the emergency stop of a robot that moves, again and again, at random phases of the tick.

    Raises:
        CaseError: the robot does not move, or does not come back.
    """
    watcher, words = robot.watcher, robot.watcher.words
    period_s = watcher.period_ns / NANOSECONDS
    speeds = robot.spec.robot == "turtlebot3"
    wanted = len(stops.stops) + count
    robot.run(600.0)
    while len(stops.stops) < wanted:
        watcher.begin()
        _until(robot, lambda batch: _moves(batch, robot.spec.robot, speeds), "move", period_s)
        time.sleep(rng.random() * 3 * period_s)
        watcher.drain()
        before = time.monotonic_ns()
        words[Word.ESTOP] = 1
        after = time.monotonic_ns()
        _until(robot, lambda batch: bool(len(batch)) and batch["mode"][-1] == Mode.ESTOP, "stop", period_s)
        _until(robot, lambda batch: bool(np.any(batch["mode"] == Mode.HOLD)), "take commands again", period_s)
        if watcher.drops:
            raise CaseError(f"{watcher.drops} states were overwritten before the benchmark could read them")
        if after - before > _PRESS_NS:
            stops.unsure += 1
            continue
        stops.stops.append(judge_stop(watcher.records(), before, commands_speeds=speeds))
    robot.pause()


def _moves(batch: Any, kind: str, speeds: bool) -> bool:
    fast = reference_speed(batch, commands_speeds=speeds) >= _MOVING[kind]
    return bool((fast & (batch["mode"] == Mode.TRACKING))[-1:].any())


def _until(robot: OwnedRobot, condition: Callable[[Any], bool], what: str, period_s: float) -> None:
    until = time.monotonic() + _PATIENCE_S
    while not condition(robot.watcher.drain()):
        if time.monotonic() > until:
            raise CaseError(f"{robot.spec.name} did not {what} within {_PATIENCE_S:g} s")
        time.sleep(2 * period_s)


@dataclass
class Losses:
    """What robots did when their brains were lost.

    Attributes:
        by_kind: one `Loss` for each, by what was done and which watchdog was to notice it.
        left: what was left behind by robots whose brain was killed.
        ended_s: how long their processes took to end [s].
    """

    by_kind: dict[tuple[str, str], list[Loss]] = field(default_factory=dict)
    left: list[str] = field(default_factory=list)
    ended_s: list[float] = field(default_factory=list)


Drive = Literal["setpoints", "chunks"]
WATCHDOGS: dict[Drive, str] = {"setpoints": "command age", "chunks": "sign of life"}


def lose_spec(name: str, drive: Drive, folder: str) -> OwnerSpec:
    """Return the robot whose brain is to be lost."""
    return OwnerSpec(
        name,
        "ur5",
        {"control_hz": 1000, "physics_hz": 1000},
        {"brain_timeout_s": _BRAIN_TIMEOUT_S, "recorder_timeout_s": 600.0},
        drive,
        folder=folder,
    )


def _lose(robot: OwnedRobot, what: int, rng: random.Random) -> Loss:
    """Stop or kill the brain of a robot that moves, and watch it until it holds."""
    watcher = robot.watcher
    watcher.begin()
    period_s = watcher.period_ns / NANOSECONDS
    _until(robot, lambda batch: bool(len(batch)) and batch["mode"][-1] == Mode.TRACKING, "move", period_s)
    time.sleep(0.1 + rng.random() * 0.05)
    lost = time.monotonic_ns()
    os.kill(robot.process.pid, what)
    _until(robot, lambda batch: bool(np.any(batch["mode"] == Mode.HOLD)), "hold", period_s)
    if watcher.drops:
        raise CaseError(f"{watcher.drops} states were overwritten before the benchmark could read them")
    alive = int(watcher.words[Word.BRAIN_ALIVE])
    by_life = robot.spec.drive == "chunks"
    timeout = round((_BRAIN_TIMEOUT_S if by_life else robot.about["command_timeout_s"]) * NANOSECONDS)
    return judge_loss(watcher.records(), lost, alive + timeout if by_life else None, watcher.period_ns, timeout)


def stop_brain(robot: OwnedRobot, count: int, losses: Losses, rng: random.Random) -> None:
    """Let the brain of a robot stand still, and go on, some times."""
    found = losses.by_kind.setdefault(("SIGSTOP", WATCHDOGS[_drive(robot)]), [])
    robot.run(600.0)
    for _ in range(count):
        try:
            found.append(_lose(robot, signal.SIGSTOP, rng))
        finally:
            robot.wake()
    robot.pause()


def kill_brain(robot: OwnedRobot, losses: Losses, rng: random.Random) -> None:
    """Kill the brain of a robot, and see whether everything else ends by itself."""
    robot.run(600.0)
    losses.by_kind.setdefault(("SIGKILL", WATCHDOGS[_drive(robot)]), []).append(_lose(robot, signal.SIGKILL, rng))
    robot.process.wait()
    started = time.monotonic()
    losses.left += robot.leftovers(10.0)
    losses.ended_s.append(time.monotonic() - started)


def _drive(robot: OwnedRobot) -> Drive:
    return "chunks" if robot.spec.drive == "chunks" else "setpoints"


@dataclass
class Drops:
    """What a recorder counted that was stopped so long that states were lost.

    Attributes:
        published: states published in the stretch.
        taken: states that the recorder wrote to its log, counted by the benchmark.
        counted: drops that the recorder counted.
    """

    published: int
    taken: int
    counted: int

    @property
    def error(self) -> int:
        """Drops that were not counted, or counted for nothing."""
        return self.published - self.taken - self.counted


DROPS_HZ = 500


def drops_spec(name: str, folder: str) -> OwnerSpec:
    """Return a robot that writes every state to its log, because a frame is a tick; the ring holds half a second."""
    rates = {"control_hz": DROPS_HZ, "physics_hz": DROPS_HZ, "fps": DROPS_HZ}
    return OwnerSpec(name, "ur5", rates, {"recorder_timeout_s": 600.0, "buffer_s": 0.5}, "setpoints", folder=folder)


def count_drops(robot: OwnedRobot, stopped_s: list[float]) -> Drops:
    """Stop the recorder of a robot some times in one stretch, and compare what it counts with what it wrote."""
    block = robot.watcher.block
    log = FrameLog(block.state_dtype, block.about["frames"], block.section("frames"))
    reader: RingReader = log.reader()
    before = len(block.ring)
    taken = 0

    def read(seconds: float) -> int:
        until, found = time.monotonic() + seconds, 0
        while time.monotonic() < until:
            while reader.read() is not None:
                found += 1
            time.sleep(0.01)
        return found

    robot.run(600.0)
    taken += read(0.3)
    for seconds in stopped_s:
        with standing_still(robot.pids["recorder"]):
            taken += read(seconds)
        taken += read(0.3)
    robot.pause()
    taken += read(0.5)  # the recorder goes on until it has seen everything
    if reader.drops:
        raise CaseError(f"{reader.drops} entries of the recorder's log were overwritten before they were counted")
    return Drops(len(block.ring) - before, taken, int(robot.watcher.words[Word.RECORDER_DROPS]))


@dataclass(frozen=True)
class PlantStop:
    """What a plant did whose cerebellum was killed.

    Attributes:
        stop_ms: from the kill, or the last command if that came later, to the tick of the plant in which it stopped the
            robot by itself [ms].
        rest_ms: to the first tick at which no joint was faster than 0.01 rad/s any more [ms]; None if none was.
    """

    stop_ms: float
    rest_ms: float | None


def plant_spec(name: str, folder: str) -> OwnerSpec:
    """Return a robot whose plant is a process of its own."""
    rates = {"control_hz": 1000, "physics_hz": 1000}
    return OwnerSpec(name, "ur5", rates, {"plant_process": True}, "setpoints", folder=folder)


def kill_cerebellum(robot: OwnedRobot, rng: random.Random) -> PlantStop:
    """Kill the cerebellum of a robot that moves, and watch its plant.

    Raises:
        CaseError: the plant does not stop the robot.
    """
    link = PlantLink.of(robot.watcher.block)
    if link is None:
        raise CaseError("the robot has no plant in a process of its own")
    robot.run(600.0)
    period_s = robot.watcher.period_ns / NANOSECONDS
    _until(robot, lambda batch: _moves(batch, "ur5", False), "move", period_s)
    time.sleep(0.2 + rng.random() * period_s)
    reader, states = RingReader(link.states), []
    killed = time.monotonic_ns()
    os.kill(robot.pids["cerebellum"], signal.SIGKILL)
    until = time.monotonic() + 1.0
    while time.monotonic() < until:
        while (state := reader.read()) is not None:
            states.append(state)
        time.sleep(period_s)
    if reader.drops:
        raise CaseError(f"{reader.drops} states of the plant were overwritten before the benchmark could read them")
    return judge_plant_stop(np.array(states, link.shape.state_dtype), killed)


def judge_plant_stop(states: Any, killed_ns: int) -> PlantStop:
    """Return what a plant did, from the states that it published after a time [ns].

    Raises:
        CaseError: it did not stop the robot.
    """
    stopped = np.flatnonzero(states["phase"] == PlantPhase.STOPPED)
    if not len(stopped):
        raise CaseError("the plant did not stop the robot")
    first = int(stopped[0])
    since = max(killed_ns, int(states["command_ns"][first]))
    fastest = np.abs(states["velocity"][first:, 0]).max(axis=1)
    rest = np.flatnonzero(fastest < 0.01)
    ms = (states["due_ns"][first:] - since) / 1e6
    return PlantStop(float(ms[0]), float(ms[rest[0]]) if len(rest) else None)
