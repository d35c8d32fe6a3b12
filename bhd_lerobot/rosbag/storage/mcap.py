"""MCAP files, read in the order of their bytes, also those that end too early.

`rosbags` reads through the index at the end, sorted by time. A file that was cut off has none, and a clock that jumped
shows only in the order in which messages were written. So the records are walked here: https://mcap.dev/spec.
"""

import contextlib
import mmap
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from zlib import crc32

from bhd_lerobot.errors import DatasetError
from bhd_lerobot.rosbag.storage.qos import offered
from bhd_lerobot.rosbag.storage.unpack import MESSAGE_BYTES, Budget

_MAGIC = b"\x89MCAP0\r\n"
_SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _STATISTICS, _DATA_END = 3, 4, 5, 6, 11, 15
_HEAD = struct.Struct("<BQ")
_MESSAGE_HEAD = struct.Struct("<HIQ")
_CHUNK_HEAD = struct.Struct("<QQQI")


class McapFile:
    """One file.

    Attributes:
        channels: number -> topic, type, serialisation; those seen so far.
        publishers: number -> how many offered the channel's topic, where the recorder wrote it.
        budget: how much it may still unpack to.
        problems: what could not be read, in sentences.

    Args:
        path: the file.
        budget: how much it may unpack to; by its own size if None.

    Raises:
        DatasetError: it is no MCAP file.
    """

    def __init__(self, path: Path, budget: Budget | None = None) -> None:
        self.path = path
        self.budget = budget or Budget(path)
        self.channels: dict[int, tuple[str, str, str]] = {}
        self.publishers: dict[int, int] = {}
        self.problems: list[str] = []
        self._schemas: dict[int, str] = {0: ""}
        with path.open("rb") as file:
            if file.read(len(_MAGIC)) != _MAGIC:
                raise DatasetError(f"{path} is no MCAP file: it does not begin as one, or is empty.")
            # An open file behind it is not needed, and the pages are the kernel's.
            self._data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)

    def close(self) -> None:
        """Give the file back."""
        self._data.close()

    def summary(self) -> dict[int, int] | None:
        """Return how many messages each channel has, from the end of the file; None where that is not written."""
        end = len(self._data) - 8 - 20
        if end < 8 + 9 or self._data[-8:] != _MAGIC or self._data[end - 9 : end] != b"\x02" + struct.pack("<Q", 20):
            return None
        (start,) = struct.unpack_from("<Q", self._data, end)
        counts: dict[int, int] | None = None
        try:
            for op, at, stop in _records(self._data, start, end - 9) if 0 < start < end - 9 else ():
                self._define(op, self._data, at, stop)
                if op == _STATISTICS:
                    size = struct.unpack_from("<I", self._data, at + 42)[0]
                    counts = dict(struct.iter_unpack("<HQ", self._data[at + 46 : at + 46 + size]))
        except struct.error:
            return None
        return counts if counts is not None and counts.keys() <= self.channels.keys() else None

    def messages(self) -> Iterator[tuple[int, int, Any, int, int]]:
        """Yield channel, receive time [ns], and where its bytes lie: a buffer, first and last; in the file's order.

        Raises:
            DatasetError: it unpacks to more than any recording does, or its compression is not known.
        """
        self.problems = []
        self.budget.start()
        try:
            yield from self._walk()
        except struct.error as error:
            self._note(f"a record that describes a topic is damaged ({error}); what is before is read")

    def _walk(self) -> Iterator[tuple[int, int, Any, int, int]]:
        at, end = len(_MAGIC), len(self._data)
        finished = False
        while at < end:
            if end - at < _HEAD.size:
                break
            op, size = _HEAD.unpack_from(self._data, at)
            start = at + _HEAD.size
            if op == _DATA_END:
                finished = True
                break
            whole = start + size <= end
            if op == _CHUNK:
                yield from self._chunk(start, min(start + size, end), at, whole=whole)
            elif not whole:
                break
            elif op == _MESSAGE:
                yield (*_message(self._data, start), self._data, start + 22, start + size)
            else:
                self._define(op, self._data, start, start + size)
            if not whole:
                break
            at = start + size
        if not finished:
            self._note(
                f"it ends at byte {end} in the middle of its data, as after a crash or a cut; what is before is read"
            )

    def _note(self, what: str) -> None:
        self.problems.append(f"{self.path.name}: {what}")

    def _chunk(self, start: int, end: int, place: int, *, whole: bool) -> Iterator[tuple[int, int, Any, int, int]]:
        if end - start < _CHUNK_HEAD.size + 4:
            return
        _, _, size, checksum = _CHUNK_HEAD.unpack_from(self._data, start)
        at = start + _CHUNK_HEAD.size
        (length,) = struct.unpack_from("<I", self._data, at)
        name = self._data[at + 4 : at + 4 + length].decode(errors="replace")
        at += 4 + length + 8
        try:
            content = self.budget.unpack(name, self._data[at:end], size) if name else self._data[at:end]
        except (DatasetError, MemoryError):
            raise
        except Exception as error:  # of two libraries, and they differ in what they raise
            self._note(f"the chunk at byte {place} cannot be decompressed ({' '.join(str(error).split())}); left out")
            return
        if whole and (len(content) != size or (checksum and crc32(content) != checksum)):
            self._note(f"the chunk at byte {place} is damaged: its checksum or size is wrong; left out")
            return
        for op, first, last in _records(content, 0, len(content)):
            if op == _MESSAGE:
                if name:
                    self.budget.take(MESSAGE_BYTES)
                yield (*_message(content, first), content, first + 22, last)
            else:
                self._define(op, content, first, last)

    def _define(self, op: int, data: Any, at: int, end: int) -> None:
        if op == _SCHEMA:
            (number,) = struct.unpack_from("<H", data, at)
            self._schemas[number], _ = _text(data, at + 2, end)
        elif op == _CHANNEL:
            number, schema = struct.unpack_from("<HH", data, at)
            topic, at = _text(data, at + 4, end)
            encoding, at = _text(data, at, end)
            self.channels[number] = (topic, self._schemas.get(schema, ""), encoding)
            with contextlib.suppress(struct.error):  # what is damaged there is not needed
                self.publishers[number] = offered(_pairs(data, at, end).get("offered_qos_profiles"))


def _message(data: Any, at: int) -> tuple[int, int]:
    channel, _, received = _MESSAGE_HEAD.unpack_from(data, at)
    return channel, received


def _records(data: Any, at: int, end: int) -> Iterator[tuple[int, int, int]]:
    """Yield op code, first byte and end of the records that are whole."""
    while at + _HEAD.size <= end:
        op, size = _HEAD.unpack_from(data, at)
        start = at + _HEAD.size
        if start + size > end or (op == _MESSAGE and size < 22):
            return
        yield op, start, start + size
        at = start + size


def _text(data: Any, at: int, end: int) -> tuple[str, int]:
    (size,) = struct.unpack_from("<I", data, at)
    if at + 4 + size > end:
        raise struct.error("a text is longer than what it is in")
    return bytes(data[at + 4 : at + 4 + size]).decode(errors="replace"), at + 4 + size


def _pairs(data: Any, at: int, end: int) -> dict[str, str]:
    """Return a map of texts."""
    stop = min(at + 4 + struct.unpack_from("<I", data, at)[0], end)
    at += 4
    pairs = {}
    while at < stop:
        key, at = _text(data, at, stop)
        pairs[key], at = _text(data, at, stop)
    return pairs
