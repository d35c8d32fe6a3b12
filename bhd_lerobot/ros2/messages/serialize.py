"""Messages to bytes and back, by `rosbags`: ROS 2's serialisation, CDR."""

from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np

from bhd_lerobot.errors import ConfigError, DatasetError, unknown_name
from bhd_lerobot.ros2.messages.types import ARRAY, BASE, BYTES, NAME, type_store

Tree = Mapping[str, Any]
"""Values by field name: a constant, an array of shape (n,) or (n, m), a `Tree` for a nested message, a list of them."""


def encode(msgtype: str, fields: Tree, n: int) -> list[bytes]:
    """Return n serialised messages.

    Args:
        fields: values by name; what is left out is zero, empty or nothing. A number of each message is an array of
            shape (n,), a sequence of numbers one of shape (n, m), or of shape (m,) if all messages share it.
    """
    store = type_store()
    return [bytes(store.serialize_cdr(_message(msgtype, fields, row), msgtype)) for row in range(n)]


def encode_known(msgtype: str, fields: Tree) -> bytes:
    """Return one serialised message of those fields that its type has; see `encode`."""
    _, known = _definition(msgtype)
    return encode(msgtype, {name: value for name, value in fields.items() if name in known}, 1)[0]


def encode_one(msgtype: str, fields: Tree) -> bytes:
    """Return one serialised message.

    Raises:
        ConfigError: there is no such field, or a value is not of its type.
    """
    _check_message(msgtype, fields, msgtype)
    return encode(msgtype, fields, 1)[0]


def _check_message(msgtype: str, fields: Any, where: str) -> None:
    known = _definition(msgtype)[1]
    if not isinstance(fields, Mapping):
        raise ConfigError(f"{where} is {fields!r}; it is a mapping of {', '.join(known)}.")
    for name, value in fields.items():
        if name not in known:
            raise ConfigError(unknown_name(f"field of {msgtype}", name, known))
        _check(known[name], value, f"{name} of {msgtype}")


def _check(description: Any, value: Any, where: str) -> None:
    kind, inner = int(description[0]), description[1]
    if kind == NAME:
        _check_message(inner, value, where)
    elif kind == BASE:
        _check_base(inner[0], value, where)
    else:
        element, count = inner
        if not isinstance(value, list | tuple) and not (isinstance(value, np.ndarray) and value.ndim == 1):
            raise ConfigError(f"{where} is {value!r}; it is a list.")
        if count and (len(value) != count if kind == ARRAY else len(value) > count):
            raise ConfigError(f"{where} has {len(value)} elements, not {'' if kind == ARRAY else 'at most '}{count}.")
        for place, one in enumerate(value):
            _check(element, one, f"{where}, element {place},")


def _check_base(name: str, value: Any, where: str) -> None:
    is_truth = isinstance(value, bool)
    if name == "string":
        fits, wanted = isinstance(value, str), "text"
    elif name == "bool":
        fits, wanted = is_truth, "true or false"
    elif name.startswith("float"):
        fits, wanted = isinstance(value, int | float | np.number) and not is_truth, "a number"
    else:
        limits = np.iinfo(BYTES.get(name, name))
        is_whole = isinstance(value, int | np.integer) and not is_truth
        fits = bool(is_whole and limits.min <= value <= limits.max)
        wanted = f"a whole number from {limits.min} to {limits.max}"
    if not fits:
        raise ConfigError(f"{where} is {value!r}; it is {wanted}.")


def decode(msgtype: str, data: bytes) -> Any:
    """Return a message, with the attributes that its type has.

    Raises:
        DatasetError: it is not of this type, or its serialisation is not known.
    """
    if len(data) < 4 or data[0] != 0 or data[1] not in (0, 1):
        raise DatasetError(
            f"A message of type {msgtype} is not serialised as plain CDR: it begins with {data[:4].hex(' ')!r}, where "
            "00 00 or 00 01 was expected. The ROS 2 middleware of its sender does not write CDR; or in a bag, a "
            "plug-in of the recorder has compressed it, in a way that is not known here (ros2 bag convert removes it)."
        )
    try:
        return type_store().deserialize_cdr(data, msgtype)
    except Exception as error:  # whatever a parser of damaged bytes raises
        raise DatasetError(
            f"A message of {len(data)} bytes cannot be read as {msgtype}: {error} Its sender has another definition of "
            "this type, or in a bag, the topic's type is not that of its messages, or the bag is damaged."
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
    if kind == NAME:
        return _message(inner, value or {}, row)
    if kind == BASE:
        value = value[row] if isinstance(value, np.ndarray) else value
        return (value or "") if inner[0] == "string" else (value or 0)
    (element, count) = inner
    if int(element[0]) == BASE and element[1][0] != "string":
        values = (np.zeros(count if kind == ARRAY else 0)) if value is None else np.asarray(value)
        return np.ascontiguousarray(values[row] if values.ndim == 2 else values, np.dtype(element[1][0]))
    return [_value(element, part, row) for part in value or ()]
