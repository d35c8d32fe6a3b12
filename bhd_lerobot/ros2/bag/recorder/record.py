"""Recording the topics of a network into a bag, which can be read whenever and however the recording ends."""

import contextlib
import re
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from bhd_lerobot.datasets.storage.atomic import real
from bhd_lerobot.datasets.storage.disk import write_errors
from bhd_lerobot.errors import ConfigError, DatasetWriteError, counted
from bhd_lerobot.options.declared import OneOf, Options, Range
from bhd_lerobot.ros2.bag.recorder.receive import DEPTH, TopicReceiver
from bhd_lerobot.ros2.bag.storage.place import refuse_existing
from bhd_lerobot.ros2.bag.storage.write import FORMATS, BagWriter, profile
from bhd_lerobot.ros2.live.graph import Endpoint
from bhd_lerobot.ros2.live.network import Qos
from bhd_lerobot.ros2.live.node import Node
from bhd_lerobot.ros2.live.topics import is_hidden
from bhd_lerobot.ros2.live.type_description import find_type_of

_POLL_S = 0.02
_DISCOVER_S, _EAGER_S, _EAGER_FOR_S = 0.5, 0.1, 5.0  # how often new topics are looked for, and at the beginning
_NAMED_S = 5.0  # within which a publisher's node is known
_FLUSH_S = 0.5
LEAST_FREE = 64 << 20
"""Of the disk, what a recording leaves [bytes]."""


@dataclass(frozen=True)
class RecordOptions(Options, prefix="--"):
    """What is recorded, and where to.

    Attributes:
        exclude: regular expression of the whole names of topics that are left out.
        seconds: when it ends [s]; never if None.
    """

    output: Path
    topics: tuple[str, ...] = ()
    exclude: str | None = None
    storage: Annotated[str, OneOf(FORMATS)] = "mcap"
    seconds: Annotated[float, Range("(0, inf]")] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.output.suffix in (".mcap", ".db3"):
            raise ConfigError(
                f"--output is {self.output}; a bag is a folder, in which the file lies. Leave out {self.output.suffix}."
            )
        try:
            re.compile(self.exclude or "")
        except re.error as error:
            raise ConfigError(f"--exclude is {self.exclude!r}, which is no regular expression: {error}.") from error

    def wants(self, topic: str) -> bool:
        """Return whether a topic is recorded."""
        if self.exclude is not None and re.fullmatch(self.exclude, topic):
            return False
        return topic in self.topics if self.topics else not is_hidden(topic)


@dataclass
class RecordReport:
    """What was recorded.

    Attributes:
        counts: topic and type -> messages.
        left_out: topic and type -> why it was not recorded.
    """

    output: Path
    counts: dict[tuple[str, str], int] = field(default_factory=dict)
    lost: dict[tuple[str, str], int] = field(default_factory=dict)
    left_out: dict[tuple[str, str], str] = field(default_factory=dict)
    first_ns: int = 0
    last_ns: int = 0

    @property
    def messages(self) -> int:
        """How many messages were recorded."""
        return sum(self.counts.values())

    @property
    def duration_s(self) -> float:
        """From the first message to the last [s]."""
        return (self.last_ns - self.first_ns) / 1e9


@dataclass
class _Recorded:
    receiver: TopicReceiver
    connection: Any = None
    offers: list[Qos] = field(default_factory=list)  # those that are in the bag
    last_ns: int = 0


class Recorder:
    """Records until it is stopped.

    The time of a message is when it was received: within the 20 ms in which it was found, when it was sent. It never
    goes back, whatever the clocks do.
    """

    def __init__(self, node: Node, options: RecordOptions, print_line: Callable[[str], None]) -> None:
        refuse_existing(options.output, "--output")
        self._node, self._options, self._print = node, options, print_line
        self._folder = real(options.output)  # it may be named by a link, or as the one that this process is in
        self._recorded: dict[tuple[str, str], _Recorded] = {}
        self._unknown: dict[tuple[str, str], float] = {}  # since when there are topics of types that are not known [s]
        self._stack = contextlib.ExitStack()
        self._bag: BagWriter | None = None
        self._wall_ns = time.time_ns() - time.monotonic_ns()
        self.report = RecordReport(options.output)

    def missing(self) -> list[str]:
        """Return the topics that were named and that nobody has published yet."""
        there = {topic for topic, _ in (*self._recorded, *self.report.left_out)}
        return [topic for topic in self._options.topics if topic not in there]

    def run(self, stop: Callable[[], bool]) -> RecordReport:
        """Record until `stop` returns true, or the time is over.

        Raises:
            DatasetWriteError: the bag cannot be written any more; what was written can be read.
        """
        output = self._options.output
        with write_errors("record", output, "What was recorded before can be read."), self._stack:
            try:
                is_full = self._record(stop)
            except Exception:
                self._count_lost()
                self._print_lost()
                raise
            self._count_lost()
        if is_full:
            self._print_lost()
            raise DatasetWriteError(
                f"The disk of {output} has less than {LEAST_FREE >> 20} MiB left, so the recording was ended. The bag "
                f"is complete up to here: {self.report.messages} messages. Free some space on this disk."
            )
        return self.report

    def _record(self, stop: Callable[[], bool]) -> bool:
        """Record until that is to end; return whether the disk is full."""
        begun = time.monotonic()
        end = None if self._options.seconds is None else begun + self._options.seconds
        discover_at = flush_at = begun
        is_full = False
        while not stop() and not is_full and (end is None or time.monotonic() < end):
            now = time.monotonic()
            if now >= discover_at:
                self._discover()
                discover_at = now + (_EAGER_S if now < begun + _EAGER_FOR_S else _DISCOVER_S)
            time.sleep(_POLL_S)
            self._take()
            if self._bag is not None and now >= flush_at:
                self._bag.flush()
                flush_at = now + _FLUSH_S
                is_full = shutil.disk_usage(self._folder).free < LEAST_FREE
        self._take()
        return is_full

    def _discover(self) -> None:
        publishers: dict[tuple[str, str], list[Endpoint]] = {}
        for one in self._node.graph.endpoints():
            if one.is_publisher and not one.is_own and self._options.wants(one.topic):
                publishers.setdefault((one.topic, one.msgtype), []).append(one)
        for key, offered in publishers.items():
            if key in self.report.left_out:
                continue
            if key not in self._recorded and not self._begin(key, offered):
                continue
            self._update(key, self._recorded[key], offered)

    def _begin(self, key: tuple[str, str], offered: list[Endpoint]) -> bool:
        topic, msgtype = key
        try:
            find_type_of(self._node, offered[0])
        except ConfigError as error:
            since = self._unknown.setdefault(key, time.monotonic())
            if offered[0].type_hash and not offered[0].node and time.monotonic() < since + _NAMED_S:
                return False  # its node, which may know the type, is not known yet
            self.report.left_out[key] = str(error)
            self._print(f"{topic} is left out: {error}")
            return False
        self._recorded[key] = _Recorded(TopicReceiver(self._node, topic, msgtype))
        self.report.counts[key] = 0
        self._print(f"{topic}  {msgtype}")
        return True

    def _update(self, key: tuple[str, str], one: _Recorded, offered: list[Endpoint]) -> None:
        """Receive what publishers offer, and write what that is: anew for the messages that follow if more come."""
        offers = [endpoint.qos for endpoint in offered]
        one.receiver.update(offers)
        if self._bag is None:
            if self._folder.is_dir():
                self._folder.rmdir()  # it is empty, and is made anew
            self._bag = self._stack.enter_context(BagWriter(self._folder, self._options.storage, {}))
        if more := [qos for qos in offers if qos not in one.offers]:
            one.offers += more
            profiles = [
                profile(qos.depth, reliable=qos.reliable, transient_local=qos.transient_local) for qos in one.offers
            ]
            one.connection = self._bag.connect(*key, profiles, offered[0].type_hash)

    def _take(self) -> None:
        shift_ns = time.time_ns() - time.monotonic_ns()
        found: list[tuple[int, Any, bytes]] = []
        for key, one in self._recorded.items():
            since_ns, arrivals = one.receiver.taken_ns, one.receiver.take()
            if not arrivals:
                continue
            for arrival in arrivals:
                received = min(max(arrival.sent_ns - shift_ns, since_ns), arrival.arrived_ns) + self._wall_ns
                one.last_ns = max(one.last_ns, received)
                found.append((one.last_ns, one.connection, arrival.data))
            self.report.counts[key] += len(arrivals)
            if len(arrivals) >= DEPTH:
                self._print(f"{key[0]}: {len(arrivals)} messages waited, more than are kept; some may be lost.")
        if not found or self._bag is None:
            return
        found.sort(key=lambda message: message[0])
        self.report.first_ns = self.report.first_ns or found[0][0]
        for received, connection, data in found:
            self.report.last_ns = max(self.report.last_ns, received)
            self._bag.append(connection, self.report.last_ns, data)

    def _count_lost(self) -> None:
        lost = {key: one.receiver.lost for key, one in self._recorded.items()}
        self.report.lost = {key: count for key, count in lost.items() if count}

    def _print_lost(self) -> None:
        """Print what a report would say, where an error takes its place."""
        for (topic, _), count in self.report.lost.items():
            self._print(f"{topic}: {counted(count, 'message')} lost.")
