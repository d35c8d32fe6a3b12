"""ROS 2's serialisation (CDR) of many messages at once: where a field lies is found once, then numpy moves them all.

Messages of one topic mostly differ in their numbers only: as long as texts and sequences keep their lengths, every
field stays at the same byte. Encoding fills a structured array; `ros2_cdr_read` is the way back.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from bhd_lerobot.rosbag.messages.types import type_store

Tree = Mapping[str, Any]
"""Values by field name: a constant, an array of shape (n,) or (n, m), a `Tree` for a nested message, a list of them."""

_HEADER = b"\x00\x01\x00\x00"  # CDR, little-endian
NUMPY = {
    **dict.fromkeys(("bool", "byte", "char"), "u1"),
    **{f"int{bits}": f"i{bits // 8}" for bits in (8, 16, 32, 64)},
    **{f"uint{bits}": f"u{bits // 8}" for bits in (8, 16, 32, 64)},
    **{f"float{bits}": f"f{bits // 8}" for bits in (32, 64)},
}
"""Name of a number in ROS -> its type in numpy."""
BASE, NAME, ARRAY = 1, 2, 3  # of rosbags' Nodetype; what remains is a sequence


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
        if kind == NAME:
            self.message(inner, {} if value is None else value)
        elif kind == BASE:
            self._base(inner[0], 0 if value is None else value)
        else:
            (element, count) = inner
            values = (np.zeros(count) if kind == ARRAY else []) if value is None else value
            size = values.shape[-1] if isinstance(values, np.ndarray) else len(values)
            if kind != ARRAY:
                self._leaf("u4", (), size)
            if int(element[0]) == BASE and element[1][0] != "string":
                if size:
                    self._leaf(NUMPY[element[1][0]], (size,), values)
            else:
                for one in values:
                    self._field(element, one)

    def _base(self, kind: str, value: Any) -> None:
        if kind == "string":
            text = (value or "").encode()
            self._leaf("u4", (), len(text) + 1)
            self._leaf(f"S{len(text) + 1}", (), text, align=1)
        else:
            self._leaf(NUMPY[kind], (), value)

    def _leaf(self, kind: str, shape: tuple[int, ...], value: Any, align: int | None = None) -> None:
        kind = kind if kind.startswith("S") else f"<{kind}"
        dtype = np.dtype(kind)
        align = align or dtype.itemsize
        self._at += -(self._at - 4) % align
        self._leaves.append((self._at, kind, shape, value))
        self._at += dtype.itemsize * int(np.prod(shape))
