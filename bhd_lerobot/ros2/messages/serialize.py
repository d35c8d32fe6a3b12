"""Messages to bytes and back, by `rosbags`: ROS 2's serialisation, CDR."""

from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np

from bhd_lerobot.errors import DatasetError
from bhd_lerobot.ros2.messages.types import type_store

Tree = Mapping[str, Any]
"""Values by field name: a constant, an array of shape (n,) or (n, m), a `Tree` for a nested message, a list of them."""

_BASE, _NAME, _ARRAY = 1, 2, 3  # of rosbags' Nodetype; what remains is a sequence


def encode(msgtype: str, fields: Tree, n: int) -> list[bytes]:
    """Return n serialised messages.

    Args:
        msgtype: their type.
        fields: values by name; what is left out is zero, empty or nothing. A number of each message is an array of
            shape (n,), a sequence of numbers one of shape (n, m), or of shape (m,) if all messages share it.
        n: how many.
    """
    store = type_store()
    return [bytes(store.serialize_cdr(_message(msgtype, fields, row), msgtype)) for row in range(n)]


def decode(msgtype: str, data: bytes) -> Any:
    """Return a message, with the attributes that its type has.

    Raises:
        DatasetError: it is not of this type, or its serialisation is not known.
    """
    if len(data) < 4 or data[0] != 0 or data[1] not in (0, 1):
        raise DatasetError(
            f"A message of type {msgtype} is not serialised as plain CDR: it begins with {data[:4].hex(' ')!r}, where "
            "00 00 or 00 01 was expected. Either a plug-in of the recorder has compressed it, in a way that is not "
            "known here (ros2 bag convert removes it), or the ROS 2 middleware that was recorded does not write CDR."
        )
    try:
        return type_store().deserialize_cdr(data, msgtype)
    except Exception as error:  # whatever a parser of damaged bytes raises
        raise DatasetError(
            f"A message of {len(data)} bytes cannot be read as {msgtype}: {error} The topic's type in the bag is not "
            "that of its messages, or the bag is damaged."
        ) from error


def _message(msgtype: str, fields: Tree, row: int) -> Any:
    made, known = _definition(msgtype)
    if not fields.keys() <= known.keys():
        raise KeyError(f"{msgtype} has no field {sorted(fields.keys() - known.keys())}")
    return made(*[_value(kind, fields.get(name), row) for name, kind in known.items()])


@cache
def _definition(msgtype: str) -> tuple[Any, dict[str, Any]]:
    """Return a type's class, and the descriptions of its fields in order."""
    return type_store().types[msgtype], dict(type_store().fielddefs[msgtype][1])


def _value(description: Any, value: Any, row: int) -> Any:
    kind, inner = int(description[0]), description[1]
    if kind == _NAME:
        return _message(inner, value or {}, row)
    if kind == _BASE:
        value = value[row] if isinstance(value, np.ndarray) else value
        return (value or "") if inner[0] == "string" else (value or 0)
    (element, count) = inner
    if int(element[0]) == _BASE and element[1][0] != "string":
        values = (np.zeros(count if kind == _ARRAY else 0)) if value is None else np.asarray(value)
        return np.ascontiguousarray(values[row] if values.ndim == 2 else values, np.dtype(element[1][0]))
    return [_value(element, part, row) for part in value or ()]
