"""ROS 2's serialisation (CDR) of many messages at once: where a field lies is found once, then numpy moves them all.

Messages of one topic mostly differ in their numbers only: as long as texts and sequences keep their lengths, every
field stays at the same byte. Encoding fills a structured array; decoding groups messages by their lengths.
"""

import struct
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.data.ros2_types import type_store
from bhd_lerobot.errors import DatasetError

Tree = Mapping[str, Any]
"""Values by field name: a constant, an array of shape (n,) or (n, m), a `Tree` for a nested message, a list of them."""

_HEADER = b"\x00\x01\x00\x00"  # CDR, little-endian
_SIZES = {
    **dict.fromkeys(("bool", "byte", "char", "int8", "uint8"), 1),
    **dict.fromkeys(("int16", "uint16"), 2),
    **dict.fromkeys(("int32", "uint32", "float32"), 4),
    **dict.fromkeys(("int64", "uint64", "float64"), 8),
}
_NUMPY = {
    **dict.fromkeys(("bool", "byte", "char"), "u1"),
    **{f"int{bits}": f"i{bits // 8}" for bits in (8, 16, 32, 64)},
    **{f"uint{bits}": f"u{bits // 8}" for bits in (8, 16, 32, 64)},
    **{f"float{bits}": f"f{bits // 8}" for bits in (32, 64)},
}
_BASE, _NAME, _ARRAY = 1, 2, 3  # of rosbags' Nodetype; what remains is a sequence


def encode(msgtype: str, fields: Tree, n: int) -> list[bytes]:
    """Return n serialised messages.

    Args:
        msgtype: their type.
        fields: values by name; what is left out is zero, empty or nothing. Texts and the lengths of sequences are the
            same in all messages: a sequence of numbers is an array of shape (n, m), or a list that all share.
        n: how many.
    """
    encoder = _Encoder(n)
    encoder.message(msgtype, fields)
    return encoder.messages()


class _Encoder:
    """Lays a message out, and remembers what goes where."""

    def __init__(self, n: int) -> None:
        self._n, self._at = n, 4
        self._leaves: list[tuple[int, str, tuple[int, ...], Any]] = []

    def messages(self) -> list[bytes]:
        # fastcdr and rosbags fill the last word up; readers take both
        kinds = {
            "names": [f"f{index}" for index in range(len(self._leaves))],
            "formats": [(kind, shape) for _, kind, shape, _ in self._leaves],
            "offsets": [offset for offset, _, _, _ in self._leaves],
            "itemsize": self._at,
        }
        rows: Any = np.zeros(self._n, dtype=np.dtype(kinds))  # type: ignore[call-overload]
        for index, (_, _, _, value) in enumerate(self._leaves):
            rows[f"f{index}"] = value
        data, size = rows.tobytes(), self._at
        return [_HEADER + data[start + 4 : start + size] for start in range(0, len(data), size)]

    def message(self, msgtype: str, fields: Tree) -> None:
        known = type_store().fielddefs[msgtype][1]
        if unknown := fields.keys() - {name for name, _ in known}:
            raise KeyError(f"{msgtype} has no field {sorted(unknown)}")
        for name, description in known:
            self._field(description, fields.get(name))

    def _field(self, description: Any, value: Any) -> None:
        kind, inner = int(description[0]), description[1]
        if kind == _NAME:
            self.message(inner, {} if value is None else value)
        elif kind == _BASE:
            self._base(inner[0], 0 if value is None else value)
        else:
            (element, count) = inner
            values = (np.zeros(count) if kind == _ARRAY else []) if value is None else value
            size = values.shape[-1] if isinstance(values, np.ndarray) else len(values)
            if kind != _ARRAY:
                self._leaf("u4", (), size)
            if int(element[0]) == _BASE and element[1][0] != "string":
                if size:
                    self._leaf(_NUMPY[element[1][0]], (size,), values)
            else:
                for one in values:
                    self._field(element, one)

    def _base(self, kind: str, value: Any) -> None:
        if kind == "string":
            text = (value or "").encode()
            self._leaf("u4", (), len(text) + 1)
            self._leaf(f"S{len(text) + 1}", (), text, align=1)
        else:
            self._leaf(_NUMPY[kind], (), value)

    def _leaf(self, kind: str, shape: tuple[int, ...], value: Any, align: int | None = None) -> None:
        kind = kind if kind.startswith("S") else f"<{kind}"
        dtype = np.dtype(kind)
        align = align or dtype.itemsize
        self._at += -(self._at - 4) % align
        self._leaves.append((self._at, kind, shape, value))
        self._at += dtype.itemsize * int(np.prod(shape))


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
    groups = list(_groups(msgtype, messages))
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


def _groups(msgtype: str, messages: Sequence[bytes | memoryview]) -> Iterator[tuple[NDArray[np.intp], "_Group"]]:
    """Yield messages of the same layout, as their indices and what is in them."""
    sizes = np.array([len(message) for message in messages], np.int64)
    for size in np.unique(sizes):
        rows = np.flatnonzero(sizes == size)
        block: NDArray[np.uint8] = np.frombuffer(b"".join(messages[row] for row in rows), np.uint8).reshape(
            len(rows), size
        )
        while len(rows):
            layout = _Layout(msgtype, block[0].tobytes())
            same = np.ones(len(rows), np.bool_)
            for at in (*range(min(4, size)), *(at + byte for at in layout.lengths for byte in range(4))):
                same &= block[:, at] == block[0, at]
            yield rows[same], _Group(layout, np.ascontiguousarray(block[same]))
            rows, block = rows[~same], block[~same]


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
    """

    def __init__(self, msgtype: str, data: bytes) -> None:
        self.leaves: dict[str, tuple[int, str, int | None]] = {}
        self.counts: dict[str, int] = {}
        self.lengths: list[int] = []
        self._data, self._at, self._msgtype = data, 4, msgtype
        if len(data) < 4 or data[0] != 0 or data[1] not in (0, 1):
            raise DatasetError(
                f"A message of type {msgtype} is not serialised as plain CDR: it begins with {data[:4].hex(' ')!r}, "
                "where 00 00 or 00 01 was expected. Record the bag with a ROS 2 middleware that writes CDR."
            )
        self._order = "<" if data[1] else ">"
        self._message(msgtype, "")
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
        if kind == _NAME:
            self._message(inner, f"{path}.")
        elif kind == _BASE:
            self._base(inner[0], path)
        else:
            element, count = inner
            count = count if kind == _ARRAY else self._length()
            if int(element[0]) == _BASE and element[1][0] != "string":
                # Without elements nothing is aligned for them.
                self._leaf(_NUMPY[element[1][0]], path, count)
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
            self._leaf(_NUMPY[kind], path, None)

    def _leaf(self, kind: str, path: str, count: int | None) -> None:
        size = _SIZES_OF[kind]
        if count != 0:
            self._align(size)
        self.leaves[path] = (self._at, f"{self._order}{kind}", count)
        self._take(size * (1 if count is None else count), path)

    def _length(self) -> int:
        self._align(4)
        self.lengths.append(self._at)
        self._take(4, "a length")
        return int(struct.unpack_from(f"{self._order}I", self._data, self._at - 4)[0])

    def _align(self, size: int) -> None:
        self._at += -(self._at - 4) % size

    def _take(self, size: int, what: str) -> None:
        self._at += size
        if self._at > len(self._data):
            raise self._wrong(f"it ends after {len(self._data)} bytes, in {what}")


_SIZES_OF = {_NUMPY[kind]: size for kind, size in _SIZES.items()}
