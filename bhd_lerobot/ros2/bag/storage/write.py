"""rosbag2 folders."""

import heapq
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self

from bhd_lerobot.errors import ConfigError, unknown_name
from bhd_lerobot.ros2.messages.types import DEFINITIONS, require_rosbags, type_store

FORMATS = ("mcap", "sqlite3")
_VERSION: Literal[8] = 8  # of rosbag2's metadata: the newest whose quality of service Humble reads, too
_FOREVER = (9223372036, 854775807)  # [s, ns] 2^63 - 1 ns, which ROS 2 takes for no limit


@dataclass(frozen=True)
class Stream:
    """The messages of one topic.

    Attributes:
        messages: when each was received [ns], in order, and its bytes.
        latched: late subscribers get the last message, too (transient local).
    """

    topic: str
    msgtype: str
    messages: Iterable[tuple[int, bytes]]
    latched: bool = False


def profile(depth: int, *, reliable: bool = True, transient_local: bool = False) -> Any:
    """Return a quality of service as a bag has it; all messages are kept with a depth of 0."""
    from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

    forever = QosTime(*_FOREVER)
    return Qos(
        QosHistory.KEEP_LAST if depth else QosHistory.KEEP_ALL,
        depth,
        QosReliability.RELIABLE if reliable else QosReliability.BEST_EFFORT,
        QosDurability.TRANSIENT_LOCAL if transient_local else QosDurability.VOLATILE,
        forever, forever, QosLiveliness.AUTOMATIC, forever, False,
    )  # fmt: skip


class BagWriter:
    """Writes one bag; use it as a context manager. After an exception inside the bag is as at the last `flush`."""

    def __init__(self, path: Path, storage: str, custom: Mapping[str, str]) -> None:
        require_rosbags()
        if storage not in FORMATS:
            raise ConfigError(unknown_name("format", storage, FORMATS))
        from bhd_lerobot.ros2.bag.storage.crash_safe import CrashSafeWriter

        self._writer = CrashSafeWriter(path, storage, _VERSION)
        for key, value in custom.items():
            self._writer.set_custom_data(key, value)
        self._connections: dict[str, Any] = {}

    def __enter__(self) -> Self:
        """Create the folder."""
        self._writer.open()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """Write index and metadata, or give up."""
        self._writer.__exit__(kind, error, traceback)

    def write(self, streams: Iterable[Stream]) -> int:
        """Write streams in the order of time; at the same time in the order given. Return how many messages."""
        count = 0
        for time_ns, _, connection, payload in heapq.merge(*map(self._timed, range(10**6), streams), key=_order):
            self.append(connection, time_ns, payload)
            count += 1
        return count

    def append(self, connection: Any, time_ns: int, payload: bytes) -> None:
        """Write a message of a topic, of which `connect` was called, after all that were written before."""
        self._writer.write(connection, time_ns, payload)

    def flush(self) -> None:
        """Make the bag one that can be read with all that was written so far, also if this process is killed."""
        self._writer.flush()

    def _timed(self, place: int, stream: Stream) -> Iterator[tuple[int, int, Any, bytes]]:
        connection = self._connections.get(stream.topic)
        if connection is None:
            kept = profile(1 if stream.latched else 10, transient_local=stream.latched)
            connection = self._connections[stream.topic] = self.connect(stream.topic, stream.msgtype, [kept])
        return ((time_ns, place, connection, payload) for time_ns, payload in stream.messages)

    def connect(self, topic: str, msgtype: str, profiles: Iterable[Any], type_hash: str = "") -> Any:
        """Add a topic; once for each type that it has.

        Args:
            type_hash: of the type's definition, as its publishers state it; computed if empty.
        """
        store = type_store()
        text, _ = store.generate_msgdef(msgtype, ros_version=2)
        if msgtype in DEFINITIONS:  # with its comments
            _, separator, rest = text.partition("=" * 80)
            text = DEFINITIONS[msgtype].lstrip() + separator + rest
        return self._writer.add_connection(
            topic,
            msgtype,
            msgdef=text,
            rihs01=type_hash or store.hash_rihs01(msgtype),
            offered_qos_profiles=list(profiles),
        )


def _order(item: tuple[int, int, Any, bytes]) -> tuple[int, int]:
    return item[0], item[1]
