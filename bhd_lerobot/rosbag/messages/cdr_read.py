"""ROS 2's serialisation (CDR), read: messages are grouped by their lengths, and each group is one array."""

import struct
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.errors import DatasetError
from bhd_lerobot.rosbag.messages.cdr import ARRAY, BASE, NAME, NUMPY
from bhd_lerobot.rosbag.messages.types import type_store


def decode(msgtype: str, messages: Sequence[bytes | memoryview], wanted: Sequence[str]) -> dict[str, NDArray[Any]]:
    """Return fields of many messages.

    Args:
        msgtype: their type.
        messages: serialised.
        wanted: paths of fields, such as ``"header.stamp.sec"``, of numbers, texts, or sequences of them.

    Returns:
        By path: numbers and texts as an array of shape (n,); sequences of numbers as one of shape (n, m) if all have
        the same length; all others as an array of n objects.

    Raises:
        DatasetError: a message is not of this type, or its serialisation is not known.
    """
    groups = []
    for rows, layout, block in _groups(msgtype, messages):
        if layout.error is not None:
            raise layout.error
        groups.append((rows, _Group(layout, block)))
    result: dict[str, NDArray[Any]] = {}
    for path in wanted:
        parts = [(rows, group.column(path)) for rows, group in groups]
        kinds = {(part.dtype, part.shape[1:]) for _, part in parts}
        if len(kinds) == 1:
            dtype, shape = kinds.pop()
            column = np.empty((len(messages), *shape), dtype)
        else:
            column = np.empty(len(messages), object)
            parts = [(rows, _objects(part)) for rows, part in parts]
        for rows, part in parts:
            column[rows] = part
        result[path] = column
    return result


def _objects(part: NDArray[Any]) -> NDArray[Any]:
    objects = np.empty(len(part), object)
    objects[:] = list(part)
    return objects


def readable(msgtype: str, messages: Sequence[bytes | memoryview]) -> tuple[NDArray[np.bool_], DatasetError | None]:
    """Return which messages `decode` can read, shape (n,), and why it cannot read the first of the others."""
    mask = np.ones(len(messages), np.bool_)
    first, reason = len(messages), None
    for rows, layout, _ in _groups(msgtype, messages):
        if layout.error is not None:
            mask[rows] = False
            if int(rows[0]) < first:
                first, reason = int(rows[0]), layout.error
    return mask, reason


def _groups(
    msgtype: str, messages: Sequence[bytes | memoryview]
) -> Iterator[tuple[NDArray[np.intp], "_Layout", NDArray[np.uint8]]]:
    """Yield messages of the same layout, or of the same fault: their indices, what is where, and their bytes."""
    sizes = np.array([len(message) for message in messages], np.int64)
    for size in np.unique(sizes):
        rows = np.flatnonzero(sizes == size)
        block: NDArray[np.uint8] = np.frombuffer(b"".join(messages[row] for row in rows), np.uint8).reshape(
            len(rows), size
        )
        left = np.arange(len(rows))
        while len(left):
            first = block[left[0]]
            layout = _Layout(msgtype, first.tobytes())
            fixed = [*range(min(4, size)), *(at + byte for at in layout.lengths for byte in range(4))]
            same = (block[left[:, None], fixed] == first[fixed]).all(axis=1)
            alike = left[same]
            yield rows[alike], layout, block if len(alike) == len(block) else block[alike]
            left = left[~same]


class _Group:
    """Messages of one layout, shape (n, bytes)."""

    def __init__(self, layout: "_Layout", block: NDArray[np.uint8]) -> None:
        self._layout, self._block = layout, block

    def column(self, path: str) -> NDArray[Any]:
        if path in self._layout.counts:  # a sequence of texts
            parts = [self.column(f"{path}.{index}") for index in range(self._layout.counts[path])]
            rows = np.empty(len(self._block), object)
            rows[:] = list(zip(*parts, strict=True)) if parts else [()] * len(rows)
            return rows
        at, kind, count = self._layout.leaves[path]
        dtype = np.dtype(kind)
        if dtype.kind == "S":
            raw = self._block[:, at : at + dtype.itemsize]
            if (raw == raw[:1]).all():  # the rule: a frame's name, a label
                return np.full(len(raw), _text(raw[0].tobytes()), object)
            return np.array([_text(row.tobytes()) for row in raw], object)
        size = dtype.itemsize * (1 if count is None else count)
        raw = np.ascontiguousarray(self._block[:, at : at + size])
        if not size:
            return np.zeros((len(raw), 0), dtype.newbyteorder("="))
        values = raw.view(dtype).astype(dtype.newbyteorder("="), copy=False)
        return values[:, 0] if count is None else values


def _text(raw: bytes) -> str:
    return raw.removesuffix(b"\0").decode("utf-8", errors="replace")


class _Layout:
    """Where the fields of one message lie.

    Attributes:
        leaves: path -> first byte, numpy type, and how many; None for a single one.
        counts: paths of sequences of texts or messages -> their lengths.
        lengths: first bytes of the words that say how long something is.
        error: why it cannot be read; all messages that have the same lengths cannot, then.
    """

    def __init__(self, msgtype: str, data: bytes) -> None:
        self.leaves: dict[str, tuple[int, str, int | None]] = {}
        self.counts: dict[str, int] = {}
        self.lengths: list[int] = []
        self._data, self._at, self._msgtype = data, 4, msgtype
        self.error: DatasetError | None = None
        try:
            self._parse()
        except DatasetError as error:
            self.error = error

    def _parse(self) -> None:
        data = self._data
        if len(data) < 4 or data[0] != 0 or data[1] not in (0, 1):
            raise DatasetError(
                f"A message of type {self._msgtype} is not serialised as plain CDR: it begins with "
                f"{data[:4].hex(' ')!r}, where 00 00 or 00 01 was expected. Either a plug-in of the recorder has "
                "compressed it, in a way that is not known here (ros2 bag convert takes that away), or the ROS 2 "
                "middleware that was recorded does not write CDR."
            )
        self._order = "<" if data[1] else ">"
        self._message(self._msgtype, "")
        if not 0 <= len(data) - self._at < 8:  # the last word may be filled up
            raise self._wrong(f"it has {len(data)} bytes, and its fields take {self._at}")

    def _wrong(self, why: str) -> DatasetError:
        return DatasetError(
            f"A message cannot be read as {self._msgtype}: {why}. The topic's type in the bag is not that of its "
            "messages, or the bag is damaged."
        )

    def _message(self, msgtype: str, prefix: str) -> None:
        for name, description in type_store().fielddefs[msgtype][1]:
            self._field(description, f"{prefix}{name}")

    def _field(self, description: Any, path: str) -> None:
        kind, inner = int(description[0]), description[1]
        if kind == NAME:
            self._message(inner, f"{path}.")
        elif kind == BASE:
            self._base(inner[0], path)
        else:
            element, count = inner
            count = count if kind == ARRAY else self._length()
            if int(element[0]) == BASE and element[1][0] != "string":
                # Without elements nothing is aligned for them.
                self._leaf(NUMPY[element[1][0]], path, count)
                return
            if count > len(self._data):
                raise self._wrong(f"{path} has {count} elements")
            self.counts[path] = count
            for index in range(count):
                self._field(element, f"{path}.{index}")

    def _base(self, kind: str, path: str) -> None:
        if kind == "string":
            length = self._length()
            self.leaves[path] = (self._at, f"S{max(length, 1)}", None)
            self._take(length, path)
        else:
            self._leaf(NUMPY[kind], path, None)

    def _leaf(self, kind: str, path: str, count: int | None) -> None:
        size = np.dtype(kind).itemsize
        if count != 0:
            self._align(size)
        self.leaves[path] = (self._at, f"{self._order}{kind}", count)
        self._take(size * (1 if count is None else count), path)

    def _length(self) -> int:
        self._align(4)
        self._take(4, "a length")
        self.lengths.append(self._at - 4)
        return int(struct.unpack_from(f"{self._order}I", self._data, self._at - 4)[0])

    def _align(self, size: int) -> None:
        self._at += -(self._at - 4) % size

    def _take(self, size: int, what: str) -> None:
        self._at += size
        if self._at > len(self._data):
            raise self._wrong(f"it ends after {len(self._data)} bytes, in {what}")
