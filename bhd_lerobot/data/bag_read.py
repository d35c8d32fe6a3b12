"""Bags as they are: folders or files, SQLite or MCAP, in the order in which they were written, damage and all."""

import contextlib
import re
import shutil
import tempfile
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from bhd_lerobot.data.bag_mcap import McapFile, zstd
from bhd_lerobot.data.bag_sqlite import SqliteFile
from bhd_lerobot.errors import DatasetError

_KINDS: dict[str, Any] = {".mcap": McapFile, ".db3": SqliteFile}
_HEAD_BYTES = 256  # that are enough for a header

_END_OF_TIME = 1 << 63  # [ns] more do not fit into a time


@dataclass(frozen=True)
class Topic:
    """A topic of a bag: its name, its type, and how many messages it has."""

    name: str
    msgtype: str
    count: int


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


@dataclass
class Bag:
    """A bag.

    Attributes:
        path: the folder or file.
        files: its files in order.
        expected: messages that its metadata count; None if it has none.
        problems: what is wrong with it and did not keep it from being read, in sentences.
        per_message: whether each message is compressed.
    """

    path: Path
    files: list[Path]
    expected: int | None = None
    problems: list[str] = field(default_factory=list)
    per_message: bool = False

    def topics(self) -> dict[str, Topic]:
        """Return its topics by name.

        Raises:
            DatasetError: a file cannot be read at all, or a topic has messages of two types.
        """
        found: dict[str, Topic] = {}
        for file in self._open():
            counts = file.summary()
            if counts is None:
                counts = {}
                for channel, *_ in file.messages():
                    counts[channel] = counts.get(channel, 0) + 1
                self._note(file.problems)
            for number, (name, msgtype, serialisation) in file.channels.items():
                if serialisation not in ("cdr", "") and counts.get(number):
                    raise DatasetError(
                        f"{name} in {self.path} is serialised as {serialisation!r}; only cdr can be read."
                    )
                before = found.get(name, Topic(name, msgtype, 0))
                if before.msgtype != msgtype:
                    raise DatasetError(
                        f"{name} in {self.path} has messages of two types, {before.msgtype} and {msgtype}. Make a bag "
                        "with one of them: ros2 bag convert."
                    )
                found[name] = Topic(name, msgtype, before.count + counts.get(number, 0))
        return found

    def read(self, topics: Collection[str], heads: Collection[str] = ()) -> dict[str, Messages]:
        """Return the messages of some topics.

        Args:
            topics: these.
            heads: of these, which may be large, only the first bytes, with the header.

        Raises:
            DatasetError: a file cannot be read at all.
        """
        times: dict[str, list[int]] = {name: [] for name in (*topics, *heads)}
        order: dict[str, list[int]] = {name: [] for name in (*topics, *heads)}
        data: dict[str, list[bytes]] = {name: [] for name in (*topics, *heads)}
        problems, total, lost = [], 0, 0
        for file in self._open():
            wanted: dict[int, tuple[list[int], list[int], list[bytes], int | None]] = {}
            for channel, received, buffer, first, last in file.messages():
                total += 1
                if channel not in wanted:
                    name = file.channels.get(channel, ("", "", ""))[0]
                    ours = (times.get(name, []), order.get(name, []), data.get(name, []))
                    wanted[channel] = (*ours, _HEAD_BYTES if name in heads else None if name in topics else 0)
                stamps, places, payloads, size = wanted[channel]
                if size == 0:
                    continue
                payload = bytes(buffer[first:last])
                if self.per_message:
                    try:
                        payload = zstd().decompress(payload)
                    except Exception:  # of whichever zstd there is
                        lost += 1
                        continue
                if not 0 <= received < _END_OF_TIME:
                    lost += 1
                    continue
                places.append(total)
                stamps.append(received)
                payloads.append(payload if size is None else payload[:size])
            problems += file.problems
        if lost:
            problems.append(f"{self.path.name}: {lost} messages that cannot be decompressed, or have no possible time")
        if self.expected is not None and total < self.expected and not problems:
            problems.append(f"{self.path.name}: its metadata count {self.expected} messages; it has {total}")
        self._note(problems)
        return {
            name: Messages(np.array(times[name], np.int64), np.array(order[name], np.int64), data[name])
            for name in times
        }

    def _note(self, problems: Iterable[str]) -> None:
        self.problems += [problem for problem in problems if problem not in self.problems]

    def payloads(self, topic: str) -> Iterator[bytes]:
        """Yield the whole messages of a topic, in the order in which `read` has them."""
        for file in self._open():
            for channel, _, buffer, first, last in file.messages():
                if file.channels.get(channel, ("",))[0] == topic:
                    payload = bytes(buffer[first:last])
                    yield zstd().decompress(payload) if self.per_message else payload

    def _open(self) -> Iterator[Any]:
        for path in self.files:
            with _plain(path) as plain, contextlib.closing(_KINDS[plain.suffix](plain)) as file:
                yield file


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
        """Return a message, by its place in what `Bag.read` returns."""
        if place < self._place:
            self._place, self._payloads = -1, self._bag.payloads(self._topic)
        while self._place < place:
            self._payload = next(self._payloads)
            self._place += 1
        return self._payload


def find_bags(path: Path) -> list[Bag]:
    """Return the bag at a path, or the bags in a folder of bags.

    Raises:
        DatasetError: there is none, or a file of one is missing.
    """
    if path.is_file():
        if _suffix(path) not in _KINDS:
            raise DatasetError(f"{path} is no bag: its name ends in neither .mcap nor .db3, by option with .zstd.")
        return [Bag(path, [path])]
    if not path.is_dir():
        raise DatasetError(f"There is no bag at {path}: it does not exist.")
    if bag := _folder(path):
        return [bag]
    inside = [bag for folder in sorted(path.iterdir(), key=_natural) if folder.is_dir() and (bag := _folder(folder))]
    if not inside:
        raise DatasetError(
            f"There is no bag at {path}: it has no metadata.yaml, no .mcap and no .db3 file, and no folder that has."
        )
    return inside


def _folder(path: Path) -> Bag | None:
    files = sorted((file for file in path.iterdir() if _suffix(file) in _KINDS and file.is_file()), key=_natural)
    metadata = path / "metadata.yaml"
    if not metadata.is_file():
        problem = f"{path.name}: it has no metadata.yaml, as after a recording that was killed"
        return Bag(path, files, problems=[problem]) if files else None
    try:
        told = yaml.safe_load(metadata.read_text(encoding="utf-8"))["rosbag2_bagfile_information"]
        # rosbag2's first versions wrote the folder in front of the name, and a moved bag has another one
        names = [Path(name).name for name in told["relative_file_paths"]]
        expected, mode = int(told["message_count"]), str(told.get("compression_mode") or "").lower()
    except (OSError, yaml.YAMLError, KeyError, TypeError, ValueError, UnicodeDecodeError) as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        if not files:
            raise DatasetError(f"{metadata} cannot be read ({reason[:200]}), and there is no bag file.") from error
        return Bag(path, files, problems=[f"{path.name}: metadata.yaml cannot be read ({reason[:200]})"])
    missing = [name for name in names if not (path / name).is_file()]
    if missing:
        there = ", ".join(file.name for file in files) or "none"
        raise DatasetError(f"{path} lacks its file {missing[0]}, which metadata.yaml lists; bag files there: {there}.")
    wrong = [name for name in names if _suffix(Path(name)) not in _KINDS]
    if wrong:
        raise DatasetError(f"{path / wrong[0]} is neither MCAP nor SQLite, and cannot be read.")
    return Bag(path, [path / name for name in names], expected, per_message=mode == "message")


def _suffix(path: Path) -> str:
    return Path(path.stem).suffix if path.suffix == ".zstd" else path.suffix


def _natural(path: Path) -> list[tuple[int, str]]:
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", path.name)]


@contextlib.contextmanager
def _plain(path: Path) -> Iterator[Path]:
    """Give a file without the compression around it."""
    if path.suffix != ".zstd":
        yield path
        return
    with tempfile.TemporaryDirectory(prefix="bhd-bag-") as folder:
        target = Path(folder) / path.stem
        try:
            with zstd().open(path, "rb") as packed, target.open("wb") as file:
                shutil.copyfileobj(packed, file)
        except (EOFError, zstd().ZstdError) as error:
            if not target.stat().st_size:
                raise DatasetError(f"{path} cannot be decompressed: {error}. Restore it from a copy.") from error
        yield target
