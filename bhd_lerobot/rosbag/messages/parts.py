"""What a topic carries of a feature: numbers that become messages, and come back as they were.

Numbers are float64 in the messages, and ranges float32, as they are in the dataset.
"""

import re
import struct
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, override

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.errors import DatasetError
from bhd_lerobot.rosbag.messages import types
from bhd_lerobot.rosbag.messages.cdr import encode
from bhd_lerobot.rosbag.messages.cdr_read import decode

Array = NDArray[np.float64]
NANO = 1_000_000_000

XYZ, WXYZ = ("x", "y", "z"), ("w", "x", "y", "z")

_STAMP = ("header.stamp.sec", "header.stamp.nanosec")


@dataclass(frozen=True)
class Frames:
    """Frames of an episode that messages are made for.

    Attributes:
        episode: its index.
        index: numbers of the frames, shape (n,).
        stamps: when the messages are stamped [ns], shape (n,).
    """

    episode: int
    index: NDArray[np.int64]
    stamps: NDArray[np.int64]


def stamp_tree(stamps: NDArray[np.int64]) -> dict[str, NDArray[np.int64]]:
    """Return `builtin_interfaces/msg/Time` of times [ns]."""
    return {"sec": stamps // NANO, "nanosec": stamps % NANO}


def header(stamps: NDArray[np.int64], frame: str = "") -> dict[str, Any]:
    """Return `std_msgs/msg/Header`."""
    return {"stamp": stamp_tree(stamps), "frame_id": frame}


def header_stamps(msgtype: str, messages: Sequence[bytes]) -> NDArray[np.int64]:
    """Return the stamps [ns] of messages with a header, shape (n,)."""
    seconds, nanoseconds = decode(msgtype, messages, _STAMP).values()
    return seconds.astype(np.int64) * NANO + nanoseconds


def head_stamps(topic: str, heads: Sequence[bytes]) -> NDArray[np.int64]:
    """Return the stamps [ns] of messages of which only the beginning is there, and which begin with a header.

    Raises:
        DatasetError: one is too short.
    """
    if any(len(head) < 12 for head in heads):
        raise DatasetError(f"A message of {topic} is too short for a header.")
    pairs = [struct.unpack_from("<iI" if head[1] else ">iI", head, 4) for head in heads]
    return np.array([seconds * NANO + nanoseconds for seconds, nanoseconds in pairs], np.int64)


@dataclass(frozen=True)
class Part(ABC):
    """Numbers of a feature that one topic carries.

    Attributes:
        topic: the topic.
        names: of the numbers, in the order in which they are given and taken.
    """

    topic: str
    names: tuple[str, ...]

    msgtype: ClassVar[str]

    @abstractmethod
    def encode(self, frames: Frames, values: Array) -> list[bytes]:
        """Return messages of values, shape (n, len(names))."""

    @abstractmethod
    def decode(self, messages: Sequence[bytes]) -> Array:
        """Return the values in messages, shape (n, len(names)).

        Raises:
            DatasetError: they are not what this part writes.
        """

    def __len__(self) -> int:
        """Return how many numbers it carries."""
        return len(self.names)


class NumbersPart(Part):
    """Numbers that no standard message is made for."""

    msgtype = types.NUMBERS

    @override
    def encode(self, frames: Frames, values: Array) -> list[bytes]:
        fields = {
            "header": header(frames.stamps),
            "episode_index": frames.episode,
            "frame_index": frames.index,
            "names": list(self.names),
            "values": values,
        }
        return encode(self.msgtype, fields, len(values))

    @override
    def decode(self, messages: Sequence[bytes]) -> Array:
        values = decode(self.msgtype, messages, ("values",))["values"]
        if values.ndim != 2 or values.shape[1] != len(self.names):
            raise DatasetError(f"{self.topic} does not have {len(self.names)} numbers in each message.")
        return values


class IntegersPart(NumbersPart):
    """Whole numbers, or truths."""

    msgtype = types.INTEGERS


def own_topic(key: str) -> str:
    """Return the topic of a feature that goes into a message of ours."""
    return "/bhd/" + re.sub(r"[^A-Za-z0-9_]+", "_", key).strip("_")
