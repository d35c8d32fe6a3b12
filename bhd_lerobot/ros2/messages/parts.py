"""What a topic carries of a feature: numbers that become messages.

Numbers are float64 in the messages, and ranges float32, as they are in the dataset.
"""

import dataclasses
import re
import struct
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, override

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.ros2.messages import types
from bhd_lerobot.ros2.messages.fields import Field
from bhd_lerobot.ros2.messages.serialize import encode
from bhd_lerobot.ros2.messages.table import path_of

Array = NDArray[np.float64]
NANO = 1_000_000_000


@dataclass(frozen=True)
class Frames:
    """Frames of an episode that messages are made for.

    Attributes:
        index: numbers of the frames, shape (n,).
        stamps: when the messages are stamped [ns], shape (n,).
    """

    episode: int
    index: NDArray[np.int64]
    stamps: NDArray[np.int64]

    def at(self, number: int) -> "Frames":
        """Return one of the frames, by its place among them."""
        part = slice(number, number + 1)
        return Frames(self.episode, self.index[part], self.stamps[part])

    def fields(self) -> dict[str, Any]:
        """Return the fields that all messages of ours begin with."""
        return {"header": header(self.stamps), "episode_index": self.episode, "frame_index": self.index}


def stamp_tree(stamps: NDArray[np.int64]) -> dict[str, NDArray[np.int64]]:
    """Return `builtin_interfaces/msg/Time` of times [ns]."""
    return {"sec": stamps // NANO, "nanosec": stamps % NANO}


def header(stamps: NDArray[np.int64], frame: str = "") -> dict[str, Any]:
    """Return `std_msgs/msg/Header`."""
    return {"stamp": stamp_tree(stamps), "frame_id": frame}


def header_stamps(messages: Sequence[Any]) -> NDArray[np.int64]:
    """Return the stamps [ns] of messages with a header, shape (n,)."""
    return np.array([message.header.stamp.sec * NANO + message.header.stamp.nanosec for message in messages], np.int64)


def head_stamps(heads: Sequence[bytes]) -> NDArray[np.int64]:
    """Return the stamps [ns] of messages of which only the first 12 bytes or more are there, with a header's stamp."""
    pairs = [struct.unpack_from("<iI" if head[1] else ">iI", head, 4) for head in heads]
    return np.array([seconds * NANO + nanoseconds for seconds, nanoseconds in pairs], np.int64)


@dataclass(frozen=True)
class Part(ABC):
    """Numbers of a feature that one topic carries."""

    topic: str
    names: tuple[str, ...]
    msgtype: str

    @property
    def kind(self) -> str:
        """What it is called in an exported bag."""
        return type(self).__name__

    @abstractmethod
    def encode(self, frames: Frames, values: Array) -> list[bytes]:
        """Return messages of values, shape (n, len(names))."""


@dataclass(frozen=True)
class FieldsPart(Part):
    """Numbers of which each is a field of a standard message, as the table has it.

    Attributes:
        name: what it is called in an exported bag.
        frame: of the header; None of messages without one.
    """

    name: str = ""
    frame: str | None = None
    rest: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    @property
    @override
    def kind(self) -> str:
        return self.name

    @override
    def encode(self, frames: Frames, values: Array) -> list[bytes]:
        tree = dict(self.rest)
        if self.frame is not None:
            tree["header"] = header(frames.stamps, self.frame)
        for name, column in zip(self.names, values.T, strict=True):
            Field(self.msgtype, path_of(self.msgtype, name)).put(tree, column)
        return encode(self.msgtype, tree, len(values))


@dataclass(frozen=True)
class NumbersPart(Part):
    """Numbers that no standard message is made for."""

    msgtype: str = types.NUMBERS

    @override
    def encode(self, frames: Frames, values: Array) -> list[bytes]:
        return encode(self.msgtype, {**frames.fields(), "names": list(self.names), "values": values}, len(values))


@dataclass(frozen=True)
class IntegersPart(NumbersPart):
    """Whole numbers, or truths."""

    msgtype: str = types.INTEGERS


def own_topic(key: str) -> str:
    """Return the topic of a feature that goes into a message of ours."""
    name = re.sub(r"[^A-Za-z0-9_]+", "_", key).strip("_")
    return f"/bhd/{name}" if name[:1].isalpha() else f"/bhd/feature_{name}"  # no name in ROS begins with a digit


def camera_name(key: str) -> str:
    """Return what a camera is called in topics."""
    return own_topic(key.removeprefix(f"{keys.OBSERVATION_IMAGES}.")).removeprefix("/bhd/")


def image_topic(key: str, *, compressed: bool) -> str:
    """Return the topic of a camera's images."""
    return f"/{camera_name(key)}/image_raw" + ("/compressed" if compressed else "")
