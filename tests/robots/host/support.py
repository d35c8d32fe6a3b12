"""What the tests of robots on the wall clock share. They wait as long as it takes; what they state does not."""

import itertools
import json
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from bhd_lerobot.control.fifo import RingReader
from bhd_lerobot.control.messages import Mode, Watchdog
from bhd_lerobot.realtime.block import LiveBlock
from bhd_lerobot.realtime.shared_memory import FOLDER, PREFIX, names
from bhd_lerobot.robots.config_turtlebot3 import TurtleBot3Config
from bhd_lerobot.robots.host.config import RealtimeConfig
from bhd_lerobot.robots.host.state import WATCHDOGS
from bhd_lerobot.robots.turtlebot3 import TurtleBot3
from tests.forks import Fork
from tests.waiting import until


def relaxed(**options: Any) -> RealtimeConfig:
    """Return options with which a busy machine alone does not stop a robot."""
    return RealtimeConfig(**{"brain_timeout_s": 20.0, "most_misses": 10**6, **options})


def turtlebot(name: str, *, require_realtime: bool = False, **options: Any) -> TurtleBot3:
    """Return an unconnected base on the wall clock, in an empty place."""
    return TurtleBot3(
        TurtleBot3Config(
            id=name,
            clock="realtime",
            arena="empty",
            beams=36,
            odometry=True,
            command_timeout_s=20.0,
            require_realtime=require_realtime,
            realtime=relaxed(**options),
        )
    )


_NUMBERS = itertools.count()


def unique(name: str) -> str:
    return f"test-{name}-{os.getpid()}-{next(_NUMBERS)}"


def is_alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def is_gone(name: str) -> bool:
    return name not in names() and not any(FOLDER.glob(f"{PREFIX}{name}.*"))


def mode(robot: Any) -> Mode:
    return Mode(int(robot.host.modes[0]))


def drive(robot: TurtleBot3, speed: float = 0.2) -> None:
    """Send a base straight on, and wait until it moves."""

    def moves() -> bool:
        robot.send_action({"x.vel": speed, "theta.vel": 0.0})
        return bool(robot.get_observation()["x.vel"] > 0.5 * speed)

    until(moves, "the base moves")


def watchdog_count(state: Any, watchdog: Watchdog) -> int:
    return int(state["watchdogs"][WATCHDOGS.index(watchdog)])


class States:
    """All states that a robot publishes from now on, read by another process."""

    def __init__(self, name: str) -> None:
        self.block = LiveBlock.attach(name)
        self._reader = RingReader(self.block.ring)
        self.all: list[Any] = []

    def read(self) -> "States":
        while (state := self._reader.read()) is not None:
            self.all.append(state.copy())
        return self

    def first(self, wanted: Mode) -> int:
        return next(k for k, state in enumerate(self.all) if state["state"]["mode"] == wanted)

    def has(self, wanted: Mode) -> bool:
        return any(state["state"]["mode"] == wanted for state in self.read().all)


def drive_on(name: str, options: dict[str, Any]) -> None:
    """Connect a base, drive it, say which its real-time process is, and go on."""
    robot = turtlebot(name, **options)
    robot.connect()
    drive(robot)
    print(json.dumps({"pid": robot.host.link.pid}), flush=True)
    while True:
        robot.send_action({"x.vel": 0.2, "theta.vel": 0.0})
        time.sleep(0.05)


@contextmanager
def driving_child(name: str, log: Path, **options: Any) -> Iterator[tuple[Fork, dict]]:
    """Run a program that connects a base and drives it; yield it, and what it says about its robot."""
    process = Fork(drive_on, name, options, output=log)
    try:
        until(lambda: process.poll() is not None or log.read_text().endswith("\n"), "the base drives")
        yield process, json.loads(log.read_text())
    finally:
        process.kill()
