"""Our programs in processes of their own, for tests against real ROS 2 peers.

A busy machine alone stops neither robot: what is silent for long is found, what is late is not.
"""

import json
import os
import re
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.cli import record, serve
from bhd_lerobot.control.messages import NANOSECONDS
from bhd_lerobot.errors import RealtimeError
from bhd_lerobot.realtime.block import Word
from bhd_lerobot.robots.host.realtime import LiveHost
from bhd_lerobot.ros2.live.network import EVERY, NetworkConfig
from bhd_lerobot.ros2.live.node import Node, Publisher, Subscription
from bhd_lerobot.ros2.messages.serialize import encode
from bhd_lerobot.ros2.serve.interface import ESTOP_TOPIC, RESET_TOPIC, RESULT, RESULT_TOPIC
from tests.forks import Fork
from tests.ros2.peer_env import free_domain
from tests.waiting import until

BOOL, STATE = "std_msgs/msg/Bool", "bhd_interfaces/msg/CerebellumState"

RELAXED = ("--robot.realtime.brain_timeout_s=20", "--robot.realtime.most_misses=1000000")


class Program:
    """A program of ours, running from `with` to its end."""

    def __init__(self, main: Callable[..., int], *arguments: Any, log: Path) -> None:
        self._main, self._arguments, self.log = main, arguments, log

    def __enter__(self) -> Self:
        self.process = Fork(self._main, *self._arguments, output=self.log)
        self.pid = self.process.pid
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        if error is not None:
            error.add_note(f"{self._arguments} printed {self.text[-3000:]}")
        self.process.kill()

    def pid_of(self, part: str) -> int:
        """Return the number of one of its processes, by a part of its command line."""
        [found] = [pid for pid in _descendants(self.pid) if part in _command_line(pid)]
        return found

    @property
    def text(self) -> str:
        """What it has printed, on one line."""
        return " ".join(self.log.read_text().split())

    def wait_for(self, text: str) -> None:
        """Wait until it has printed something."""

        def printed() -> bool:
            ended = self.process.poll() is not None
            found = text in self.text
            assert found or not ended, f"it ended with {self.process.poll()}"
            return found

        until(printed, f"{text!r} is printed")

    def stop(self, number: int = signal.SIGINT) -> int:
        """End it by a signal; return its exit status."""
        self.process.send_signal(number)
        return self.process.wait()


class Served(Program):
    """`bhd-ros2 serve`."""

    def __init__(self, robot: str, *options: str, domain: int, log: Path) -> None:
        given = ["serve", f"--robot.type={robot}", f"--network.domain={domain}", *RELAXED, *options]
        super().__init__(serve.main, given, log=log)

    def __enter__(self) -> Self:
        super().__enter__()
        self.wait_for("is a ROS 2 robot")
        return self

    @property
    def contacts(self) -> tuple[int, int]:
        """In how many control ticks it was in contact, and how many there were; it has ended."""
        found = re.search(r"Contact in (\d+) of (\d+) control ticks", self.text)
        assert found, self.text
        return int(found[1]), int(found[2])


class Bridged(Program):
    """`bhd-ros2 bridge`, in front of a robot on the network."""

    def __init__(self, robot: str, *options: str, domain: int, log: Path, silence_s: float = 5) -> None:
        plant = ("--robot.plant=ros2", f"--robot.ros2.domain={domain}", f"--robot.ros2.silence_s={silence_s}")
        # However late the commands come, as on a loaded machine, a robot that follows is not blocked.
        names = {option.partition("=")[0] for option in options}
        relaxed = [one for one in RELAXED if one.partition("=")[0] not in names]
        given = ["bridge", f"--robot.type={robot}", *plant, "--robot.ros2.latency_s=1", *relaxed, *options]
        super().__init__(serve.main, given, log=log)

    def __enter__(self) -> Self:
        super().__enter__()
        self.wait_for("is behind a bridge")
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        """End it in order, so that nothing of it commands the robot any more."""
        if error is None and self.process.poll() is None:
            assert self.stop() == 0, self.text
        super().__exit__(kind, error, _)


def put(publisher: Publisher, data: bytes) -> None:
    """Send a message once there is room for it: a receiver on a busy machine may have none for now."""

    def is_sent() -> bool:
        try:
            publisher.send(data)
        except RealtimeError:
            return False
        return True

    until(is_sent, f"{publisher.topic} takes a message")


class Side:
    """Another node, and the robot that it commands."""

    def __init__(self, served: Program, node: Node) -> None:
        self.served, self.node = served, node
        self.states = node.subscription("/cerebellum/state", STATE)
        self.results = node.subscription(RESULT_TOPIC, RESULT, EVERY)
        self.diagnostics = node.subscription("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")
        self._publishers: dict[tuple[str, str], Publisher] = {}

    def publisher(self, topic: str, msgtype: str) -> Publisher:
        if (topic, msgtype) not in self._publishers:
            self._publishers[topic, msgtype] = self.node.publisher(topic, msgtype, EVERY)
        publisher = self._publishers[topic, msgtype]
        until(lambda: publisher.receivers, f"the robot receives {topic}")
        return publisher

    def send(self, topic: str, msgtype: str, fields: dict[str, Any]) -> None:
        put(self.publisher(topic, msgtype), encode(msgtype, fields, 1)[0])

    def newest(self, subscription: Subscription | None = None) -> Any:
        return until((subscription or self.states).take, "a message comes")[-1].message()

    def state(self) -> Any:
        self.states.take()
        return self.newest()

    @property
    def joints(self) -> NDArray[np.float64]:
        return np.asarray(self.state().joint_positions)[:6]

    def wait(self, holds: Callable[[Any], Any], text: str) -> None:
        until(lambda: holds(self.state()), text)

    def ended(self, count: int) -> list[Any]:
        found: list[Any] = []
        until(lambda: [found.extend(one.message() for one in self.results.take()), len(found) >= count][1], "results")
        return found

    def press(self) -> None:
        self.send(ESTOP_TOPIC, BOOL, {"data": True})
        self.wait(lambda state: state.emergency_stop, "the stop is latched")

    def reset(self) -> None:
        self.send(RESET_TOPIC, "std_msgs/msg/Empty", {})
        self.wait(lambda state: not state.emergency_stop, "the robot is reset")


def served(robot: str, folder: Path, *options: str) -> Iterator[Side]:
    """Serve a robot beside another node, for tests that share both."""
    with (
        free_domain() as domain,
        Served(robot, *options, domain=domain, log=folder / "log") as program,
        Node("other", NetworkConfig(domain=domain)) as node,
    ):
        yield Side(program, node)


def _record(options: list[str], starts: Path) -> int:
    """Record, and note when each episode begins on the monotonic clock, which a dataset does not hold [s]."""
    begin = LiveHost.begin

    def noting(host: LiveHost) -> None:
        words = host.link.block.words
        segments = int(words[Word.SEGMENT])
        begin(host)
        if words[Word.SEGMENT] > segments:
            with starts.open("a") as file:
                print(words[Word.START] / NANOSECONDS - 1 / host.rates.control_hz, file=file)

    LiveHost.begin = noting  # type: ignore[method-assign]
    return record.main(options)


class Recording(Program):
    """`bhd-record` of a robot on the network."""

    def __init__(self, robot: str, *options: str, domain: int, folder: Path, silence_s: float = 5) -> None:
        self.root, self._starts = folder / "dataset", folder / "starts"
        given = [
            f"--robot.type={robot}",
            "--robot.plant=ros2",
            f"--robot.ros2.domain={domain}",
            f"--robot.ros2.silence_s={silence_s}",
            *RELAXED,
            "--dataset.repo_id=test/ros2",
            f"--dataset.root={self.root}",
            f"--output_dir={folder / 'run'}",
            "--preview_video=false",
            *options,
        ]
        self._starts.touch()
        super().__init__(_record, given, self._starts, log=folder / "log")

    @property
    def starts(self) -> list[float]:
        """When each episode has begun, monotonic [s]."""
        return [float(line) for line in self._starts.read_text().splitlines()]

    def wait_for_episode(self, number: int) -> None:
        """Wait until an episode, counted from 1, has begun and is under way."""
        until(lambda: len(self.starts) >= number or self.process.poll() is not None, f"episode {number} begins")
        assert self.process.poll() is None, self.text
        time.sleep(1.0)


def _descendants(pid: int) -> list[int]:
    children = [
        int(child)
        for thread in Path(f"/proc/{pid}/task").iterdir()
        for child in (thread / "children").read_text().split()
    ]
    return [one for child in children for one in (child, *_descendants(child))]


def _command_line(pid: int) -> str:
    return Path(f"/proc/{pid}/cmdline").read_text().replace("\0", " ")


def log_of(path: Path, event: str) -> list[dict[str, Any]]:
    """Return the lines of a stand-in's log with this event; its last line may be incomplete."""
    with path.open() as file:
        return [json.loads(line) for line in file if line.endswith("\n") and f'"event": "{event}"' in line]


def newest_of(path: Path, event: str) -> dict[str, Any]:
    """Return the last of these lines, which is looked for at the end of the log."""
    with path.open("rb") as file:
        file.seek(-min(path.stat().st_size, 1 << 17), os.SEEK_END)
        *complete, _ = file.read().decode().split("\n")
    newest = next(line for line in reversed(complete) if line.startswith(f'{{"event": "{event}"'))
    return dict(json.loads(newest))
