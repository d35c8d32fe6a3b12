"""A robot with a node of its own, from the start of its processes to a clean stop.

Commands are taken as they arrive, topics are published on fixed grids of time.
"""

import signal
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from types import FrameType
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from bhd_lerobot.control.messages import NANOSECONDS, CerebellumState, Reason, SendResult
from bhd_lerobot.errors import DatasetError
from bhd_lerobot.robots.host.realtime import LiveHost, make_live
from bhd_lerobot.robots.host.simulation import Simulation
from bhd_lerobot.robots.viewer.viewer import viewed
from bhd_lerobot.ros2.live.graph import UNNAMED
from bhd_lerobot.ros2.live.network import require_cyclonedds
from bhd_lerobot.ros2.live.node import Node, Subscription
from bhd_lerobot.ros2.messages.parts import Frames
from bhd_lerobot.ros2.serve.config import ServiceConfig

_LONGEST_WAIT_S = 0.02
_NAMES_NS = 4 * NANOSECONDS  # the name of a node of Fast DDS comes up to a heartbeat of 3 s after its topics


@dataclass
class State:
    """What the cerebellum published last.

    Attributes:
        row: it; see `bhd_lerobot.robots.host.state.published`.
        stamp_ns: when it was measured, on the wall clock [ns].
        robot: what the robot's record reports.
    """

    row: Any
    stamp_ns: int
    robot: CerebellumState

    @classmethod
    def of(cls, host: LiveHost) -> "State":
        """Return the newest state of a robot."""
        row = host.bridge.latest
        return cls(row, int(row["sensed_ns"]) + time.time_ns() - time.monotonic_ns(), host.bridge.reported(row))

    @property
    def stamps(self) -> NDArray[np.int64]:
        """The stamp [ns], shape (1,)."""
        return np.array([self.stamp_ns])

    @property
    def frames(self) -> Frames:
        """What messages are made for."""
        return Frames(0, np.zeros(1, np.int64), self.stamps)


@dataclass
class Output:
    """Something that is published at a fixed rate.

    Attributes:
        due_ns: when it is due next, monotonic [ns].
    """

    rate_hz: float
    publish: Callable[[State], None]
    due_ns: int = 0

    def run(self, now_ns: int, host: LiveHost) -> None:
        """Publish if it is due; times that went by are left out, the grid stays."""
        if now_ns < self.due_ns:
            return
        self.publish(State.of(host))
        period = round(NANOSECONDS / self.rate_hz)
        self.due_ns += max(1, (now_ns - self.due_ns) // period + 1) * period


@dataclass
class Input:
    """A topic that commands the robot.

    Attributes:
        take: takes a message, deserialised; returns False if it is refused.
        which: of the messages that have arrived: the newest that is not refused; each, the oldest first, one in a turn
            of the loop, which goes on meanwhile; or those that differ, once each, to find one among any number.
        ready: whether more can be taken now; what comes meanwhile waits.
    """

    subscription: Subscription
    take: Callable[[Any], bool | None]
    which: Literal["newest", "each", "different"] = "newest"
    ready: Callable[[], bool] = lambda: True

    def run(self, count: "Counts") -> None:
        """Take what has arrived."""
        if not self.ready():
            return
        received = self.subscription.take(*((1,) if self.which == "each" else ()))
        if self.which == "different":
            received = list({one.data: one for one in received}.values())
        for one in reversed(received):
            try:
                message = one.message()
            except DatasetError as error:
                count.add(f"{self.subscription.topic}: {error}")
                continue
            if self.take(message) is not False and self.which == "newest":
                return


def for_nodes(text: str) -> str:
    """Return a message of the cerebellum with the remedy that a node has, in place of a program's calls."""
    return text.replace("call reset() and activate()", "send a message on /emergency_stop/reset")


@dataclass
class Counts:
    """How often what was asked for was refused, and what else became of it (such as ``cut``), by the reason."""

    refused: dict[str, int] = field(default_factory=dict)
    others: dict[tuple[str, str], int] = field(default_factory=dict)

    def add(self, reason: str) -> None:
        """Count one that was refused."""
        reason = for_nodes(reason)
        self.refused[reason] = self.refused.get(reason, 0) + 1

    def note(self, what: str, reason: str, count: int = 1) -> None:
        """Count what was not refused, but not done as it was asked for either."""
        self.others[what, reason] = self.others.get((what, reason), 0) + count

    def all(self) -> dict[tuple[str, str], int]:
        """Return how often what happened, and why."""
        return {("refused", reason): count for reason, count in self.refused.items()} | self.others

    def add_result(self, topic: str, sent: SendResult) -> None:
        """Count a command that the cerebellum refused."""
        reason = Reason(int(sent.reasons[0]))
        if reason != Reason.ACCEPTED:
            self.add(f"{topic}: {reason.explanation}")


NEVER_NS = 1 << 62


class Topics:
    """Some topics of a robot.

    Attributes:
        outputs: what is published at fixed rates.
        inputs: what commands the robot.
    """

    outputs: Sequence[Output] = ()
    inputs: Sequence[Input] = ()

    def poll(self, now_ns: int) -> int:
        """Do what is due at a monotonic time [ns]; return when there is more to do."""
        return NEVER_NS

    def end(self) -> None:
        """Send what others still wait for: the robot is no longer served."""


class Server:
    """Serves a robot."""

    def __init__(self, host: LiveHost, node: Node, parts: Iterable[Topics], counts: Counts) -> None:
        self._host, self._node, self._parts, self.counts = host, node, list(parts), counts
        self._outputs = [output for part in self._parts for output in part.outputs]
        self._inputs = [one for part in self._parts for one in part.inputs]
        # Any number of nodes may press the emergency stop.
        self._commands = {
            one.subscription.topic for one in self._inputs if "/emergency_stop" not in one.subscription.topic
        }

    def run(self, stop: Callable[[], bool], report: Callable[[str], None]) -> None:
        """Serve until `stop` returns true, and answer what others still wait for, also if an error ends it.

        Args:
            report: takes a line about what was refused, at most one a second, and about each node whose topic does not
                fit one of the robot's.

        Raises:
            RealtimeError: a process of the robot has ended.
        """
        try:
            self._serve(stop, report)
        finally:
            for part in self._parts:
                part.end()

    def _serve(self, stop: Callable[[], bool], report: Callable[[str], None]) -> None:
        start = time.monotonic_ns()
        for output in self._outputs:
            output.due_ns = start
        reported, reported_ns = self.counts.all(), start
        since: dict[str, int] = {}
        printed: set[str] = set()
        while not stop():
            now = time.monotonic_ns()
            for one in self._inputs:
                one.run(self.counts)
            for output in self._outputs:
                output.run(now, self._host)
            due = min([*(output.due_ns for output in self._outputs), *(part.poll(now) for part in self._parts)])
            if now - reported_ns > NANOSECONDS:
                reported_ns = now
                self._host.link.check()
                found = self.counts.all()
                for (what, reason), count in found.items():
                    if more := count - reported.get((what, reason), 0):
                        report(f"{what} {more}: {reason}")
                reported = found
                graph = self._node.graph
                apart = {*graph.all_mismatches(), *graph.doubles(), *graph.rivals(self._commands)}
                since = {text: since.get(text, now) for text in apart}
                due_texts = {text for text in apart if UNNAMED not in text or now - since[text] > _NAMES_NS}
                for text in sorted(due_texts - printed):
                    report(text)
                printed |= due_texts
            left = (due - time.monotonic_ns()) / NANOSECONDS
            if left > 0:
                self._node.wait(min(left, _LONGEST_WAIT_S))


def run_service(
    config: ServiceConfig,
    simulation: type[Simulation],
    scene: Any,
    parts: Callable[[LiveHost, Node, Counts], list[Topics]],
    *,
    console: Console,
    ended: threading.Event | None = None,
    title: str,
    name: str = "",
    node: Callable[..., Node] = Node,
    view: bool = False,
) -> Any:
    """Run a robot and its topics until SIGINT, SIGTERM or SIGHUP; return the robot's last state.

    Args:
        scene: in which it starts; None: where it is.
        name: of the node; the robot's type if empty.

    Raises:
        RealtimeError: a process of the robot could not be started or has ended, or the network cannot be used.
    """
    require_cyclonedds()
    end, robot = ended or threading.Event(), config.robot
    is_shown = console.is_terminal

    def stop(number: int, _: FrameType | None) -> None:
        end.set()
        console.quiet |= is_shown and number == signal.SIGHUP  # the terminal is gone: it takes nothing any more

    with ExitStack() as running:
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            if number != signal.SIGHUP or signal.getsignal(number) is not signal.SIG_IGN:  # as it is by nohup
                running.callback(signal.signal, number, signal.signal(number, stop))
        host = running.enter_context(closing(make_live(simulation, robot, robot.id)))
        running.enter_context(viewed(host, view))
        host.reset(np.zeros(1, np.intp), [scene], [getattr(robot, "seed", 0)])
        host.begin()
        for line in host.notes:
            console.print(line)
        made = running.enter_context(node(name or robot.type, config.network, config.namespace))
        counts = Counts()
        server = Server(host, made, parts(host, made, counts), counts)
        where = "this machine" if config.network.is_local else config.network.interface
        console.print(f"{robot.type} {title}: domain {config.network.domain_number}, {where}. Ctrl-C ends it.")
        if config.duration_s:
            timer = threading.Timer(config.duration_s, end.set)
            timer.daemon = True
            timer.start()
            running.callback(timer.cancel)
        # A log has one line for a message, whatever its length.
        server.run(end.is_set, lambda line: console.print(line, markup=False, soft_wrap=not console.is_terminal))
        console.print(f"Ended. Commands refused: {sum(counts.refused.values())}.")
        return host.bridge.latest.copy()
