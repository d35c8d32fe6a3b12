"""Bags as they are: folders or files, SQLite or MCAP, in the order in which they were written, damage and all."""

import contextlib
from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.errors import DatasetError
from bhd_lerobot.rosbag.storage.mcap import McapFile
from bhd_lerobot.rosbag.storage.sqlite import SqliteFile
from bhd_lerobot.rosbag.storage.unpack import Budget, plain_file

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
        count: how many messages it has.
        others: other types of which it has messages, too.
        serialisation: of its messages.
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


@dataclass
class Messages:
    """Messages of one topic in the order in which they were written.

    Attributes:
        received: when [ns], shape (n,).
        order: each one's place among all messages of the bag, shape (n,).
        sizes: each one's size [bytes], shape (n,).
        data: each one's bytes, or their beginning.
    """

    received: NDArray[np.int64]
    order: NDArray[np.int64]
    sizes: NDArray[np.int64]
    data: list[bytes]

    def part(self, mask: NDArray[np.bool_]) -> "Messages":
        """Return some of them."""
        data = [one for one, wanted in zip(self.data, mask.tolist(), strict=True) if wanted]
        return Messages(self.received[mask], self.order[mask], self.sizes[mask], data)


@dataclass
class Bag:
    """A bag.

    Attributes:
        path: the folder or file.
        files: its files in order.
        expected: messages that its metadata count; None if it has none.
        problems: what is wrong with it and did not keep it from being read, in sentences.
        per_message: whether its metadata say that each message is compressed.
        publishers: topic -> how many offered it, by its metadata.
    """

    path: Path
    files: list[Path]
    expected: int | None = None
    problems: list[str] = field(default_factory=list)
    per_message: bool = False
    publishers: dict[str, int] = field(default_factory=dict)

    def topics(self) -> dict[str, Topic]:
        """Return its topics by name.

        Raises:
            DatasetError: a file cannot be read at all.
        """
        types: dict[str, Counter[tuple[str, str]]] = {}  # messages by type and serialisation
        connections: dict[str, list[int]] = {}
        publishers = dict(self.publishers)
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
                publishers[name] = max(publishers.get(name, 0), file.publishers.get(number, 0))
            for name, several in here.items():
                connections[name] = max(connections.get(name, []), several, key=len)
        found = {}
        for name, kinds in types.items():
            (msgtype, serialisation), _ = kinds.most_common(1)[0]
            others = sorted({kind for (kind, _), count in kinds.items() if count} - {msgtype})
            each = tuple(connections[name]) if len(connections[name]) > 1 else ()
            total = sum(kinds.values())
            found[name] = Topic(
                name, msgtype, total, tuple(others), serialisation or "cdr", each, publishers.get(name, 0)
            )
        return found

    def read(self, topics: Collection[str], heads: Collection[str] = ()) -> dict[str, Messages]:
        """Return the messages of some topics.

        Args:
            topics: these.
            heads: of these, which may be large, only the first bytes, with the header.

        Raises:
            DatasetError: a file cannot be read at all.
        """
        rows: dict[str, list[tuple[int, int, int, bytes]]] = {name: [] for name in (*topics, *heads)}
        walk = _Walk(self, rows)
        for name, received, place, payload in walk.messages():
            kept = payload[:_HEAD_BYTES] if name in heads else payload
            rows[name].append((received, place, len(payload), kept))
        problems = walk.problems
        if walk.lost:
            problems.append(
                f"{self.path.name}: {walk.lost} messages that cannot be decompressed, or have no possible time"
            )
        if walk.packed and not self.per_message:
            problems.append(
                f"{self.path.name}: its messages are compressed one by one (compression_mode: MESSAGE), which only the "
                "missing metadata.yaml could say; they were decompressed"
            )
        if self.expected is not None and walk.total < self.expected and not problems:
            problems.append(f"{self.path.name}: its metadata count {self.expected} messages; it has {walk.total}")
        self._note(problems)
        return {name: _messages(found) for name, found in rows.items()}

    def payloads(self, topic: str) -> Iterator[tuple[int, bytes]]:
        """Yield the messages of a topic that `read` has: their places among all messages of the bag, and all bytes."""
        for _, _, place, payload in _Walk(self, (topic,)).messages():
            yield place, payload

    def _note(self, problems: Iterable[str]) -> None:
        self.problems += [problem for problem in problems if problem not in self.problems]

    def _open(self) -> Iterator[Any]:
        for path in self.files:
            with plain_file(path) as plain, contextlib.closing(FILES[plain.suffix](plain, Budget(path))) as file:
                yield file


def _messages(rows: list[tuple[int, int, int, bytes]]) -> Messages:
    received, order, sizes, data = zip(*rows, strict=True) if rows else ((), (), (), ())
    return Messages(np.array(received, np.int64), np.array(order, np.int64), np.array(sizes, np.int64), list(data))


class _Walk:
    """One way through a bag's messages, in the order in which they were written.

    Attributes:
        total: messages that the bag has, of all topics.
        lost: messages of the wanted topics that cannot be decompressed, or have no possible time.
        packed: messages that were compressed.
        problems: what could not be read, in sentences.
    """

    def __init__(self, bag: Bag, wanted: Collection[str]) -> None:
        self.total = self.lost = self.packed = 0
        self.problems: list[str] = []
        self._bag, self._wanted = bag, wanted

    def messages(self) -> Iterator[tuple[str, int, int, bytes]]:
        """Yield topic, receive time [ns], place among all messages, and bytes."""
        total = 0
        for file in self._bag._open():
            names: dict[int, str] = {}
            for channel, received, buffer, first, last in file.messages():
                total += 1
                if channel not in names:
                    told = file.channels.get(channel, ("",))[0]
                    names[channel] = told if told in self._wanted else ""
                name = names[channel]
                if not name:
                    continue
                payload = bytes(buffer[first:last])
                if payload[:4] == _ZSTD:  # a serialised message never begins so
                    self.packed += 1
                    try:
                        payload = file.budget.unpack("zstd", payload)
                    except (DatasetError, MemoryError):
                        raise
                    except Exception:  # of whichever zstd there is
                        self.lost += 1
                        continue
                if 0 <= received < _END_OF_TIME:
                    yield name, received, total, payload
                else:
                    self.lost += 1
            self.total = total
            self.problems += file.problems


class Picker:
    """Gives large messages of a topic one by one, reading on in the bag; best asked for in their order.

    Args:
        bag: the bag.
        topic: the topic.
    """

    def __init__(self, bag: Bag, topic: str) -> None:
        self._bag, self._topic = bag, topic
        self._place, self._payload = -1, b""
        self._payloads = bag.payloads(topic)

    def get(self, place: int) -> bytes:
        """Return a message, by its place among all messages of the bag (`Messages.order`)."""
        if place < self._place:
            self._place, self._payloads = -1, self._bag.payloads(self._topic)
        while self._place < place:
            self._place, self._payload = next(self._payloads)
        return self._payload


def first_time(path: Path) -> int | None:
    """Return when the first message of a file was received [ns]; None if it cannot be read."""
    try:
        with plain_file(path) as plain, contextlib.closing(FILES[plain.suffix](plain, Budget(path))) as file:
            return next((int(received) for _, received, *_ in file.messages()), None)
    except DatasetError:
        return None
