"""Message types for Cyclone DDS whose samples stay serialised: `rosbags` reads and writes their bytes.

The dataclasses of Cyclone DDS take 0.3 µs for each byte of an image.
"""

from functools import cache
from importlib import import_module
from typing import Any

from bhd_lerobot.ros2.messages.definitions import find_type
from bhd_lerobot.ros2.messages.types import ARRAY, BASE, BYTES, NAME, type_store

_KINDS = {"bool": bool, "string": str}


def dds_type_name(msgtype: str) -> str:
    """Return the name of a ROS 2 type on the network: ``std_msgs/msg/String`` is ``std_msgs::msg::dds_::String_``."""
    package, kind, name = msgtype.split("/")
    return f"{package}::{kind}::dds_::{name}_"


def ros_type_name(name: str) -> str:
    """Return the ROS 2 name of a type on the network; a name that no ROS 2 type has is returned as it is."""
    return name.removesuffix("_").replace("::dds_::", "::").replace("::", "/") if "::dds_::" in name else name


@cache
def sample_class(msgtype: str) -> Any:
    """Return the class of a type's samples, whose `data` is the serialised message with its encapsulation header."""
    made = _nested(msgtype)
    made.serialize = lambda sample, *_, **__: sample.data
    made.deserialize = classmethod(lambda _, data, *__, **___: raw(made, bytes(data)))
    return made


def raw(made: Any, data: bytes) -> Any:
    """Return a sample of a class that `sample_class` returned."""
    sample = made.__new__(made)
    sample.data = data
    return sample


@cache
def _nested(msgtype: str) -> Any:
    from cyclonedds.idl import make_idl_struct

    return make_idl_struct(_class_name(msgtype), dds_type_name(msgtype), _fields(msgtype))


def _class_name(msgtype: str) -> str:
    return msgtype.replace("/", "_")


def _fields(msgtype: str) -> dict[str, Any]:
    find_type(msgtype)
    return {name: _kind(description) for name, description in type_store().fielddefs[msgtype][1]}


def _kind(description: Any) -> Any:
    idl: Any = import_module("cyclonedds.idl.types")
    kind, inner = int(description[0]), description[1]
    if kind == NAME:
        return _nested(inner)
    if kind == BASE:
        name, bound = inner
        if name == "string" and bound:
            return idl.bounded_str[bound]
        return _KINDS.get(name) or getattr(idl, BYTES.get(name, name))
    element, count = inner
    if kind == ARRAY:
        return idl.array[_kind(element), count]
    return idl.sequence[(_kind(element), count)] if count else idl.sequence[_kind(element)]
