"""Bags as they are: folders or files, SQLite or MCAP, in the order in which they were written, damage and all."""

import contextlib
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from bhd_lerobot.errors import DatasetError
from bhd_lerobot.ros2.bag.storage.mcap import McapFile
from bhd_lerobot.ros2.bag.storage.sqlite import SqliteFile
from bhd_lerobot.ros2.bag.storage.unpack import Budget, plain_file

FILES: dict[str, Any] = {".mcap": McapFile, ".db3": SqliteFile}
"""Ending of a file's name -> what reads it."""
_HEAD_BYTES = 256  # that are enough for a header

_ZSTD = b"\x28\xb5\x2f\xfd"  # that a compressed message begins with
_END_OF_TIME = 1 << 63  # [ns] more do not fit into a time


@dataclass(frozen=True)
class Topic:
    """A topic of a bag.

    Attributes:
        name, msgtype: what it is called, and the type of most of its messages.
        connections: messages of each connection (of a publisher, if the recorder kept them apart) in one of the bag's
            files; empty if there is but one.
        publishers: how many offered it when the recorder subscribed; 0 if that is not known.
    """

    name: str
    msgtype: str
    count: int
    others: tuple[str, ...] = ()
    serialisation: str = "cdr"
    connections: tuple[int, ...] = ()
    publishers: int = 0
    profiles: tuple[Any, ...] = ()


@dataclass
class Messages:
    """Messages of one topic in the order in which they were written.

    Attributes:
        received: when [ns], shape (n,).
        order: each one's place among all messages of the bag, shape (n,).
        data: each one's bytes, or their beginning.
    """

    received: NDArray[np.int64]
    order: NDArray[np.int64]
    data: list[bytes]

    def part(self, mask: NDArray[np.bool_]) -> "Messages":
        """Return some of them."""
        data = [message for message, wanted in zip(self.data, mask.tolist(), strict=True) if wanted]
        return Messages(self.received[mask], self.order[mask], data)


@dataclass(eq=False)
class Bag:
    """A bag.

    Attributes:
        expected: messages that its metadata count; None if it has none.
        per_message: whether its metadata say that each message is compressed.
        definitions: type -> its definition, as far as they are in the bag; known after `topics`.
    """

    path: Path
    files: list[Path]
    expected: int | None = None
    problems: list[str] = field(default_factory=list)
    per_message: bool = False
    publishers: dict[str, int] = field(default_factory=dict)
    definitions: dict[str, str] = field(default_factory=dict)

    @cached_property
    def topics(self) -> dict[str, Topic]:
        """Its topics by name; they are read once."""
        types: dict[str, Counter[tuple[str, str]]] = {}  # messages by type and serialisation
        connections: dict[str, list[int]] = {}
        publishers = dict(self.publishers)
        profiles: dict[str, tuple[Any, ...]] = {}
        for file in self._open():
            counts = file.summary()
            if counts is None:
                counts = Counter(channel for channel, *_ in file.messages())
                self._note(file.problems)
            here: dict[str, list[int]] = {}
            for number, (name, msgtype, serialisation) in file.channels.items():
                count = counts.get(number, 0)
                types.setdefault(name, Counter())[msgtype, serialisation] += count
                here.setdefault(name, []).extend([count] * bool(count))
                offered = profiles_in(file.profiles.get(number))
                publishers[name] = max(publishers.get(name, 0), len(offered))
                profiles[name] = max(profiles.get(name, ()), offered, key=len)
            self.definitions |= file.definitions
            for name, several in here.items():
                connections[name] = max(connections.get(name, []), several, key=len)
        found = {}
        for name, kinds in types.items():
            (msgtype, serialisation), _ = kinds.most_common(1)[0]
            others = sorted({kind for (kind, _), count in kinds.items() if count} - {msgtype})
            each = tuple(connections[name]) if len(connections[name]) > 1 else ()
            total = sum(kinds.values())
            found[name] = Topic(
                name, msgtype, total, tuple(others), serialisation or "cdr", each, publishers.get(name, 0),
                profiles[name],
            )  # fmt: skip
        return found

    def read(self, topics: Collection[str], heads: Collection[str] = ()) -> dict[str, Messages]:
        """Return the messages of some topics; what could not be read is added to `problems`.

        Args:
            heads: of these, which may be large, only the first bytes, with the header.
        """
        rows: dict[str, list[tuple[int, int, bytes]]] = {name: [] for name in (*topics, *heads)}
        for name, received, place, payload in self.messages(rows, note=True):
            rows[name].append((received, place, payload[:_HEAD_BYTES] if name in heads else payload))
        found = {}
        for name, messages in rows.items():
            times, order = (np.array([message[column] for message in messages], np.int64) for column in (0, 1))
            found[name] = Messages(times, order, [data for *_, data in messages])
        return found

    def messages(self, topics: Collection[str], *, note: bool = False) -> Iterator[tuple[str, int, int, bytes]]:
        """Yield topic, receive time [ns], place among all messages and bytes, in the order in which they were written.

        Args:
            note: whether what could not be read is added to `problems` at the end.
        """
        counts: Counter[str] = Counter()
        problems: list[str] = []
        for file in self._open():
            names: dict[int, str] = {}
            for channel, received, data in file.messages():
                counts["all"] += 1
                if channel not in names:
                    names[channel] = file.channels.get(channel, ("",))[0]
                if names[channel] not in topics:
                    continue
                is_packed = data[:4] == _ZSTD  # a serialised message never begins so
                counts["packed"] += is_packed
                payload = _unpacked(file, data) if is_packed else data
                if payload is None or not 0 <= received < _END_OF_TIME:
                    counts["lost"] += 1
                    continue
                yield names[channel], received, counts["all"], payload
            problems += file.problems
        if note:
            self._note([*problems, *self._losses(counts, has_problems=bool(problems))])

    def _losses(self, counts: Mapping[str, int], *, has_problems: bool) -> Iterator[str]:
        name = self.path.name
        if counts["lost"]:
            yield f"{name}: {counts['lost']} messages that cannot be decompressed, or have no possible time"
        if counts["packed"] and not self.per_message:
            yield (
                f"{name}: its messages are compressed one by one (compression_mode: MESSAGE), which only the missing "
                "metadata.yaml could state; they were decompressed"
            )
        elif self.expected is not None and counts["all"] < self.expected and not has_problems and not counts["lost"]:
            yield f"{name}: its metadata count {self.expected} messages; it has {counts['all']}"

    def _note(self, problems: Iterable[str]) -> None:
        self.problems += [problem for problem in problems if problem not in self.problems]

    def _open(self) -> Iterator[Any]:
        for path in self.files:
            with opened(path) as file:
                yield file


def _unpacked(file: Any, data: bytes) -> bytes | None:
    """Return a message without the compression around it; None if it is damaged."""
    try:
        return bytes(file.budget.unpack("zstd", data))
    except (DatasetError, MemoryError):
        raise
    except Exception:  # of whichever zstd there is
        return None


@contextlib.contextmanager
def opened(path: Path) -> Iterator[Any]:
    """Give a bag's file, without the compression around it, as a reader of `FILES`."""
    with plain_file(path) as plain, contextlib.closing(FILES[plain.suffix](plain, Budget(path))) as file:
        yield file


def profiles_in(profiles: Any) -> tuple[Any, ...]:
    """Return the quality of service of each publisher that offered a topic when the recorder subscribed.

    Args:
        profiles: ``offered_qos_profiles``: a YAML text in versions 4 to 8 of rosbag2's metadata, in SQLite files and in
            the channels of MCAP files; a list in version 9.
    """
    if isinstance(profiles, str):
        return _parsed(profiles)
    return tuple(profiles) if isinstance(profiles, list) else ()


@lru_cache(maxsize=256)  # a bag has few that differ, and YAML is slow
def _parsed(text: str) -> tuple[Any, ...]:
    try:
        profiles = yaml.safe_load(text)
    except (yaml.YAMLError, ValueError, RecursionError):
        return ()
    return tuple(profiles) if isinstance(profiles, list) else ()
