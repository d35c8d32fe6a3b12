"""Our robots on ROS 2 beside a pair of plain `rclpy` nodes: `python -m benchmarks.ros2`.

Latencies of commands, also through a bridge, processor time, how regular topics are, with and without a process beside
it that computes all the time; and how long a robot goes on when one of the processes that drive it is killed or
stopped. Every ratio is to the plain pair, or a plain relay, in the same run, the median of some rounds. It needs the
ROS 2 environment of the tests, which it installs on first use. Exits with 3 if a goal is missed, with 2 if nothing can
be measured here.
"""

import contextlib
import json
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from benchmarks._report import Report, parse_options
from bhd_lerobot.bodies.turtlebot3 import turtlebot3_burger
from bhd_lerobot.bodies.ur import ur5
from bhd_lerobot.ros2.live.network import Ros2Config
from bhd_lerobot.ros2.robots.arm_plant import ArmPlant
from bhd_lerobot.ros2.robots.base_plant import BasePlant
from bhd_lerobot.ros2.robots.plant import Ros2Plant
from tests.ros2 import peer_env
from tests.ros2.peer_env import Peer

WARM_UP_S = 3.0
BUSY = "beside a busy process"
READ = ("--topic=scan:5", "--topic=imu:20", "--topic=joint_states:20")  # what our plant of a base receives
PERIOD_S = 0.005  # of the control loop of a base
LIMIT_S = 0.7  # to standstill: 0.5 s and the plant's time-out, 0.2 s
KILLED = {  # a part of its command line; the brain's is the process that the others belong to
    "brain": "",
    "cerebellum": "robots.host.process",
    "node": "ros2.live.process node",
    "guard": "ros2.live.process guard",
}


class Session:
    """One round of measurements in a ROS domain.

    Attributes:
        numbers: what was measured, by name.

    Args:
        measure_s: how long each lasts [s].
    """

    def __init__(self, domain: int, measure_s: float) -> None:
        self.domain, self.measure_s = domain, measure_s
        self.numbers: dict[str, float] = {}
        self._window = (f"--warm-up={WARM_UP_S}", f"--measure={measure_s}")

    def plain(self, half: str, *options: str) -> Peer:
        """Return one half of the plain pair."""
        return Peer("plain_pair.py", half, *options, *self._window, domain=self.domain)

    def pair(self, name: str, *options: str) -> dict[str, Any]:
        """Measure the plain pair; return what its subscriber says of the topics."""
        with self.plain("subscribe", *options) as subscriber, self.plain("publish", *options) as publisher:
            summary = subscriber.wait_event("summary")
            self.numbers[f"{name}: plain publisher"] = publisher.wait_event("processor")["share"]
        topics: dict[str, Any] = summary["topics"]
        return topics

    @contextlib.contextmanager
    def program(self, module: str, *arguments: object) -> Iterator["subprocess.Popen[str]"]:
        """Run a program of ours, until it is ready and from then on until the end."""
        command = [sys.executable, "-m", module, *map(str, arguments)]
        with subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True) as process:
            assert process.stderr is not None
            try:
                for line in process.stderr:
                    if "Ctrl-C ends it" in line:
                        break
                yield process
            finally:
                process.send_signal(signal.SIGINT)
                process.stderr.read()

    def serve(self, *arguments: object) -> contextlib.AbstractContextManager["subprocess.Popen[str]"]:
        """Serve a robot."""
        return self.program("benchmarks._ros2_programs", "serve", "--domain", self.domain, *arguments)

    # --- what is measured --------------------------------------------------------------------------------------------

    def commands(self, end: str = "") -> None:
        """Measure the latency of commands at 50 Hz: to a plain callback, to our acceptance, to a control tick."""
        topics = self.pair("command", "--set=command")
        for percent in (50, 99):
            self.numbers[f"plain p{percent}{end}"] = topics["cmd_vel"][f"latency_p{percent}"]
        with tempfile.TemporaryDirectory() as folder:
            times = Path(folder) / "times"
            with self.serve("--times", times), self.plain("publish", "--set=command") as publisher:
                publisher.wait_event("processor")
            found = json.loads(times.read_text())
        for name, values in found.items():
            used = values[round(WARM_UP_S * 50) :]
            for percent in (50, 99):
                self.numbers[f"{name} p{percent}{end}"] = float(np.percentile(used, percent))

    def bridged(self) -> None:
        """Measure the latency of a twist from a brain's topic to a robot's: of a plain relay, and of our bridge."""
        bridge = ("bridge", "--robot.type=turtlebot3", "--robot.plant=ros2", f"--robot.ros2.domain={self.domain}")
        ways: dict[str, Any] = {
            "relay": Peer("plain_relay.py", "relay", domain=self.domain),
            "bridge": self.program("bhd_lerobot.cli.ros2", *bridge, "--robot.ros2.latency_s=1"),
        }
        with Peer("standin_turtlebot3.py", "--open", "--half=200", domain=self.domain) as robot:
            robot.wait_event("ready")
            for name, way in ways.items():
                with way, Peer("plain_relay.py", "measure", *self._window, domain=self.domain) as measuring:
                    summary = measuring.wait_event("summary")
                for key in ("p50", "p99", "missed"):
                    self.numbers[f"{name} {key}"] = summary[key]

    def published(self, robot: str, hz: int, end: str = "") -> None:
        """Measure how regular topics are, and what publishing them costs."""
        self._note_errors(f"plain {robot}", self.pair(f"{robot} published{end}", f"--set={robot}"), end)
        with (
            self.serve("--robot", robot, "--hz", hz) as process,
            self.plain("subscribe", f"--set={robot}") as subscriber,
        ):
            subscriber.wait_event("ready")
            self.numbers[f"{robot} published{end}: ours"] = self._share(process.pid)
            summary = subscriber.wait_event("summary")
        self._note_errors(f"ours {robot}", summary["topics"], end)

    def _note_errors(self, name: str, topics: dict[str, Any], end: str) -> None:
        for topic, measured in topics.items():
            self.numbers[f"{name} /{topic}{end}"] = measured["interval_error_p99"]

    def received(self, robot: str, plant: Ros2Plant, publisher: Sequence[str], topics: Sequence[str]) -> None:
        """Measure what receiving topics costs, of a plain subscriber and of our node with its guard."""
        with Peer(*publisher, domain=self.domain) as peer:
            peer.wait_event("ready")
            with self.plain("subscribe", *topics) as subscriber:
                self.numbers[f"{robot} received: plain"] = subscriber.wait_event("processor")["share"]
            try:
                plant.open()
                self.numbers[f"{robot} received: ours"] = self._share(*plant.link.pids.values())
            finally:
                plant.close()

    def _share(self, *pids: int) -> float:
        """Return the share of a processor that processes take."""
        time.sleep(WARM_UP_S)
        start, before = time.monotonic(), sum(map(processor_s, pids))
        time.sleep(self.measure_s)
        return (sum(map(processor_s, pids)) - before) / (time.monotonic() - start)

    def standstill(self, part: str, number: int) -> float:
        """Return how long a robot moved after one of the processes that drive it got a signal [s]."""
        with tempfile.TemporaryDirectory() as folder:
            log = Path(folder) / "log"
            stand_in = ("standin_turtlebot3.py", "--open", "--half=50", "--log", log)
            command = [sys.executable, "-m", "benchmarks._ros2_programs", "drive", "--domain", str(self.domain)]
            with (
                Peer(*stand_in, domain=self.domain) as robot,
                subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as process,
            ):
                robot.wait_event("ready")
                pids = [process.pid]
                try:
                    assert process.stdout is not None
                    process.stdout.readline()
                    pids += _descendants(process.pid)
                    time.sleep(1.5)
                    pid = next(one for one in pids if part in _command_line(one))
                    then = time.monotonic()
                    os.kill(pid, number)
                    time.sleep(LIMIT_S + 1.5)
                    robot.stop()
                finally:
                    for pid in pids:
                        with contextlib.suppress(ProcessLookupError):
                            os.kill(pid, signal.SIGKILL)
            poses = [line for line in map(json.loads, log.read_text().splitlines()) if line["event"] == "pose"]
            moving = [line["monotonic"] for line in poses if line["twist"] != [0.0, 0.0]]
            return max(0.0, max(moving) + 0.05 - then)  # the pose is noted every 0.05 s


def processor_s(pid: int) -> float:
    """Return the processor time that a process has taken [s]."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _descendants(pid: int) -> list[int]:
    threads = Path(f"/proc/{pid}/task").iterdir()
    children = [int(child) for thread in threads for child in (thread / "children").read_text().split()]
    return [one for child in children for one in (child, *_descendants(child))]


def _command_line(pid: int) -> str:
    return Path(f"/proc/{pid}/cmdline").read_text().replace("\0", " ")


@contextlib.contextmanager
def _busy() -> Iterator[None]:
    with subprocess.Popen([sys.executable, "-m", "benchmarks._ros2_programs", "compute"]) as process:
        try:
            yield
        finally:
            process.kill()


def measure(domain: int, measure_s: float) -> dict[str, float]:
    """Measure everything but standstills once; return the numbers by name."""
    session = Session(domain, measure_s)
    base = BasePlant(SimpleNamespace(beams=360, imu=True, ros2=Ros2Config(domain=domain)), turtlebot3_burger())
    arm = ArmPlant(SimpleNamespace(ros2=Ros2Config(domain=domain)), ur5())
    session.received("turtlebot3", base, ("standin_turtlebot3.py",), READ)
    session.received("ur5", arm, ("ur_driver_standin.py", "--hz=500"), ("--set=ur5",))
    session.published("ur5", 500)
    session.commands()
    session.bridged()
    session.published("turtlebot3", 125)
    with _busy():
        session.commands(f", {BUSY}")
        session.published("turtlebot3", 125, f", {BUSY}")
    return session.numbers


def report(rounds: list[dict[str, float]], stops: dict[str, float]) -> Report:
    """Return the table."""
    found = Report("Our robots on ROS 2 beside plain rclpy nodes")
    series: dict[str, list[float]] = defaultdict(list)
    for one in rounds:
        for name, value in one.items():
            series[name].append(value)
    found.numbers["rounds"], found.numbers["standstill_s"] = rounds, stops

    def compare(what: str, ours: str, plain: str, most: float | None = None) -> None:
        scale, form = (100, ".1f") if "[%]" in what else (1e3, ".2f")
        ratio = statistics.median(a / b for a, b in zip(series[ours], series[plain], strict=True))
        mine, other = (scale * statistics.median(series[name]) for name in (ours, plain))
        goal = "" if most is None else f"at most {most:g} x"
        value = f"{mine:{form}}, plain {other:{form}}: {ratio:.2f} x"
        found.add(what, value, goal, met=None if most is None else ratio <= most)

    for end in ("", f", {BUSY}"):
        for percent in (50, 99):
            name = f"latency of a command [ms], p{percent}"
            ends = f"p{percent}{end}", f"plain p{percent}{end}"
            compare(f"{name}, to its acceptance{end}", f"accepted {ends[0]}", ends[1], 1.2)
            compare(f"{name}, to the control tick{end}", f"tick {ends[0]}", ends[1])
        for topic in ("scan", "odom", "joint_states"):
            what = f"error of the interval of /{topic} [ms], p99{end}"
            names = f"ours turtlebot3 /{topic}{end}", f"plain turtlebot3 /{topic}{end}"
            compare(what, *names, 1.0)
    what = "latency of a twist from a brain's topic through the bridge to the robot's [ms], p"
    compare(f"{what}50", "bridge p50", "relay p50", 1.3)
    compare(f"{what}99", "bridge p99", "relay p99")
    late = statistics.median(series["bridge p99"])
    found.add("the 99th percentile against a control period", f"{1e3 * late:.2f} ms", f"at most {1e3 * PERIOD_S:g} ms",
              met=late <= PERIOD_S)  # fmt: skip
    what = "error of the interval of a UR5's /joint_states at 500 Hz [ms], p99"
    compare(what, "ours ur5 /joint_states", "plain ur5 /joint_states", 1.0)
    for robot, name in (("turtlebot3", "TurtleBot3's topics"), ("ur5", "UR5's joint states at 500 Hz")):
        what = f"processor [%], {name}"
        compare(f"{what}, received", f"{robot} received: ours", f"{robot} received: plain", 0.5)
        names = f"{robot} published: ours", f"{robot} published: plain publisher"
        compare(f"{what}, published, with all that serve does", *names)
    for name, seconds in stops.items():
        found.add(f"time to standstill from 0.2 m/s, {name}", f"{seconds:.2f} s", f"at most {LIMIT_S:g} s",
                  met=seconds <= LIMIT_S)  # fmt: skip
    return found


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark; return the exit status."""
    options = parse_options(
        __doc__, arguments, rounds=(3, "measure so often"), seconds=(8.0, "how long each measurement lasts [s]")
    )
    found = peer_env._environment()
    if isinstance(found, peer_env.UnavailableError):
        print(f"No ROS 2 here: {found}", file=sys.stderr)
        return 2
    stops = {}
    with peer_env.free_domain() as domain:
        rounds = [measure(domain, options.seconds) for _ in range(options.rounds)]
        for part, process in KILLED.items():
            for verb, number in (("killed", signal.SIGKILL), ("stopped", signal.SIGSTOP)):
                stops[f"{part} {verb}"] = Session(domain, options.seconds).standstill(process, number)
    return report(rounds, stops).end(options.json)


if __name__ == "__main__":
    sys.exit(main())
