"""Programs that `benchmarks.ros2` runs, each in a process of its own: `python -m benchmarks._ros2_programs NAME`."""

import argparse
import json
import math
import os
import threading
import time
from pathlib import Path
from typing import Any

from rich.console import Console

from bhd_lerobot.control.fifo import RingReader
from bhd_lerobot.registry import ROBOTS, robot_configs
from bhd_lerobot.robots.turtlebot3 import TurtleBot3
from bhd_lerobot.ros2.live.network import NetworkConfig, Ros2Config
from bhd_lerobot.ros2.messages.parts import header_stamps
from bhd_lerobot.ros2.serve import serve as served
from bhd_lerobot.ros2.serve.config import ServeConfig
from bhd_lerobot.ros2.serve.setpoints import Setpoints


class TimedSetpoints(Setpoints):
    """Twists to a base, and when they were sent, accepted, and used by a control tick [ns]."""

    made: "TimedSetpoints"

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        TimedSetpoints.made = self
        self.sent: list[int] = []
        self.accepted: list[int] = []
        self.used: list[int] = []
        self._ring = RingReader(self._host.link.block.ring)
        self._setpoints = 0

    def _drive(self, message: Any) -> bool:
        is_accepted = super()._drive(message)
        self.sent += header_stamps([message]).tolist()
        self.accepted.append(time.time_ns())
        return is_accepted

    def poll(self, now_ns: int) -> int:
        """Look for ticks that took a setpoint."""
        wall = time.time_ns() - time.monotonic_ns()
        while (state := self._ring.read()) is not None:
            if state["state"]["setpoints_taken"] != self._setpoints:
                self._setpoints = int(state["state"]["setpoints_taken"])
                self.used.append(int(state["start_ns"]) + wall)
        return super().poll(now_ns)

    def write(self, path: Path) -> None:
        """Write the latencies of all commands [s]."""
        ticks = iter(self.used)
        tick, to_tick = next(ticks, math.inf), []
        for sent in self.sent:
            while tick < sent:
                tick = next(ticks, math.inf)
            to_tick.append((tick - sent) / 1e9)
        accepted = [(after - sent) / 1e9 for sent, after in zip(self.sent, self.accepted, strict=True)]
        path.write_text(json.dumps({"accepted": accepted, "tick": [one for one in to_tick if math.isfinite(one)]}))


def serve(options: argparse.Namespace) -> None:
    """Serve a robot; with `times`, note when commands are used."""
    kind: Any = robot_configs()[options.robot]
    config = ServeConfig(
        kind(id=f"bench-{os.getpid()}"), NetworkConfig(domain=options.domain), joint_states_hz=options.hz
    )
    if options.times:
        served.Setpoints = TimedSetpoints  # type: ignore[misc, assignment]
    served.serve(config, ROBOTS.of(config.robot), Console(stderr=True))
    if options.times:
        TimedSetpoints.made.write(options.times)


def drive(options: argparse.Namespace) -> None:
    """Drive a robot on the network through its plant, at 10 Hz and 0.2 m/s."""
    kind: Any = robot_configs()["turtlebot3"]
    robot = TurtleBot3(kind(id=f"bench-{os.getpid()}", plant="ros2", ros2=Ros2Config(domain=options.domain)))
    robot.connect()
    print("ready", flush=True)
    while True:
        robot.send_action({"x.vel": 0.2, "theta.vel": 0.0})
        time.sleep(0.1)


def compute(_: argparse.Namespace) -> None:
    """Compute all the time."""
    while True:
        sum(range(1000))


def main() -> None:
    """Run the program that the command line names."""
    parent = os.getppid()
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()
    parser = argparse.ArgumentParser()
    parser.add_argument("name", choices=("serve", "drive", "compute"))
    parser.add_argument("--domain", type=int, default=0)
    parser.add_argument("--robot", default="turtlebot3")
    parser.add_argument("--hz", type=float, default=125.0)
    parser.add_argument("--times", type=Path)
    options = parser.parse_args()
    {"serve": serve, "drive": drive, "compute": compute}[options.name](options)


def _end_with(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(0.2)
    os._exit(1)


if __name__ == "__main__":
    main()
