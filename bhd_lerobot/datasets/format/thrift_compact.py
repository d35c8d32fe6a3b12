"""Thrift's compact protocol, as far as Parquet uses it: any struct as numbered fields, and back.

Parquet's headers and footer are such structs. pyarrow reads a footer but offers no way to write one by hand, which is
what a file needs whose writer was killed.
"""

import struct
from dataclasses import dataclass
from typing import Any

_TRUE, _FALSE, _BYTE, _I16, _I32, _I64, _DOUBLE, _BINARY, _LIST, _SET, _MAP, _STRUCT = range(1, 13)
_DEEPEST = 32  # nested structs; Parquet's own have fewer than ten


@dataclass
class Field:
    """A value and its wire type: bool, int, float, bytes, list of values, or dictionary of fields by number."""

    kind: int
    value: Any
    element: int = 0


type Struct = dict[int, Field]


def integer(value: int) -> Field:
    """Return a 64-bit integer field."""
    return Field(_I64, value)


class Reader:
    """Reads structs from bytes."""

    def __init__(self, data: bytes | memoryview, position: int = 0) -> None:
        self._data, self.position = data, position

    def struct(self, depth: int = 0) -> Struct:
        """Return the next struct."""
        if depth > _DEEPEST:
            raise ValueError("structs are nested too deeply")
        fields: Struct = {}
        number = 0
        while (head := self._byte()) != 0:
            delta, kind = head >> 4, head & 0x0F
            number = number + delta if delta else _unzigzag(self._varint())
            fields[number] = self._field(kind, depth)
        return fields

    def _field(self, kind: int, depth: int) -> Field:
        if kind in (_TRUE, _FALSE):
            return Field(kind, kind == _TRUE)
        if kind == _LIST:
            head = self._byte()
            size, element = head >> 4, head & 0x0F
            if size == 15:
                size = self._varint()
            if size > len(self._data) - self.position:
                raise ValueError("a list is longer than the data")
            return Field(kind, [self._value(element, depth) for _ in range(size)], element)
        return Field(kind, self._value(kind, depth))

    def _value(self, kind: int, depth: int) -> Any:
        if kind in (_TRUE, _FALSE):  # within a list a boolean has a byte of its own
            return self._byte() == _TRUE
        if kind == _BYTE:
            return self._byte()
        if kind in (_I16, _I32, _I64):
            return _unzigzag(self._varint())
        if kind == _DOUBLE:
            return struct.unpack("<d", self._bytes(8))[0]
        if kind == _BINARY:
            return bytes(self._bytes(self._varint()))
        if kind == _STRUCT:
            return self.struct(depth + 1)
        raise ValueError(f"Parquet has no field of wire type {kind}")

    def _byte(self) -> int:
        return self._bytes(1)[0]

    def _bytes(self, count: int) -> bytes | memoryview:
        end = self.position + count
        if end > len(self._data):
            raise ValueError("the data ends within a struct")
        part = self._data[self.position : end]
        self.position = end
        return part

    def _varint(self) -> int:
        value = 0
        for shift in range(0, 70, 7):
            byte = self._byte()
            value |= (byte & 0x7F) << shift
            if byte < 0x80:
                return value
        raise ValueError("a number is longer than 64 bits")


def encode(fields: Struct) -> bytes:
    """Return the bytes of a struct; the inverse of `Reader.struct`."""
    parts: list[bytes] = []
    last = 0
    for number, field in sorted(fields.items()):
        kind = field.kind if field.kind not in (_TRUE, _FALSE) else _TRUE if field.value else _FALSE
        delta = number - last
        parts.append(bytes([delta << 4 | kind]) if 0 < delta < 16 else bytes([kind]) + _varint(_zigzag(number)))
        last = number
        if kind == _LIST:
            size = len(field.value)
            head = size << 4 if size < 15 else 0xF0
            parts.append(bytes([head | field.element]) + (b"" if size < 15 else _varint(size)))
            parts += [_encoded(field.element, value) for value in field.value]
        elif kind not in (_TRUE, _FALSE):
            parts.append(_encoded(kind, field.value))
    return b"".join(parts) + b"\0"


def _encoded(kind: int, value: Any) -> bytes:
    if kind in (_TRUE, _FALSE):
        return bytes([_TRUE if value else _FALSE])
    if kind == _BYTE:
        return bytes([value])
    if kind in (_I16, _I32, _I64):
        return _varint(_zigzag(value))
    if kind == _DOUBLE:
        return struct.pack("<d", value)
    if kind == _BINARY:
        return _varint(len(value)) + value
    return encode(value)


def _varint(value: int) -> bytes:
    out = bytearray()
    while value >= 0x80:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def _zigzag(value: int) -> int:
    return value << 1 if value >= 0 else (-value << 1) - 1


def _unzigzag(value: int) -> int:
    return value >> 1 if value & 1 == 0 else -(value + 1 >> 1)
