"""What a node in a process of its own receives and sends."""

from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.ros2.live.network import NetworkConfig, Qos
from bhd_lerobot.ros2.messages.mapping import TopicFields


def silence_text(topic: str, silent_s: float) -> str:
    """Return that a topic is silent, in the one wording of whoever notices it first: its node or the control loop."""
    return f"{topic} has sent no message for {silent_s:.2f} s"


class Reader(Protocol):
    """Takes numbers from messages of a type."""

    @property
    def width(self) -> int:
        """How many."""

    def read(self, message: Any) -> NDArray[np.float64]:
        """Return the numbers in a deserialised message, shape (width,).

        Raises:
            DatasetError: they are not there.
        """


class Writer(Protocol):
    """Makes messages of a type."""

    @property
    def width(self) -> int:
        """How many numbers a message is made of."""

    def encode(self, features: NDArray[np.float64], stamp_ns: int) -> bytes:
        """Return the serialised message of some numbers, shape (width,), stamped [ns]."""


@dataclass(frozen=True)
class InputSpec:
    """A topic that is received.

    Attributes:
        topic, msgtype, qos: of the subscription; what is transient local is received from volatile publishers, too.
        silence_s: without a message for so long it is silent, which is a problem [s]; infinite for a topic that is sent
            when something changes, which is not waited for either: its numbers are not a number until then.
    """

    topic: str
    msgtype: str
    reader: Reader
    qos: Qos = field(default_factory=Qos)
    silence_s: float = 1.0

    @classmethod
    def of(cls, fields: TopicFields, qos: Qos | None = None, silence_s: float = 1.0) -> Self:
        """Return the input of a topic of which fields are read."""
        return cls(fields.topic, fields.msgtype, fields, qos or Qos(), silence_s)

    @property
    def is_required(self) -> bool:
        """Whether it is waited for."""
        return np.isfinite(self.silence_s).item()


@dataclass(frozen=True)
class OutputSpec:
    """A topic that is sent.

    Attributes:
        remedy: what to do if a node receives another type.
        stop: the numbers that stop the robot, sent when no command comes any more; None for a robot that stops by
            itself.
    """

    topic: str
    msgtype: str
    writer: Writer
    qos: Qos = field(default_factory=Qos)
    is_required: bool = True
    remedy: str = ""
    stop: tuple[float, ...] | None = None

    @classmethod
    def of(cls, fields: TopicFields, qos: Qos | None = None, **options: Any) -> Self:
        """Return the output of a topic whose fields are written."""
        return cls(fields.topic, fields.msgtype, fields, qos or Qos(), **options)


@dataclass(frozen=True)
class CameraSpec:
    """A topic of images.

    Attributes:
        width, height: of an image [px].
    """

    name: str
    topic: str
    msgtype: str
    width: int
    height: int
    qos: Qos = field(default_factory=lambda: Qos(2, reliable=False))
    silence_s: float = 1.0


@dataclass(frozen=True)
class NodeSpec:
    """A node.

    Attributes:
        command_hz: a new command is sent at once, but at most so often [Hz]; without one, the last is repeated half as
            often.
        timeout_s: without a command for so long the stop is sent instead [s].
        is_synchronised: whether the clocks of the other machines are that of this one.
        is_alone: whether another publisher on a topic that is sent is a problem.
    """

    name: str
    network: NetworkConfig
    inputs: tuple[InputSpec, ...] = ()
    outputs: tuple[OutputSpec, ...] = ()
    cameras: tuple[CameraSpec, ...] = ()
    command_hz: float = 50.0
    timeout_s: float = 0.2
    is_synchronised: bool = False
    is_alone: bool = True

    @property
    def columns(self) -> tuple[slice, ...]:
        """Where the numbers of each input are among all of them."""
        ends = np.cumsum([0, *(one.reader.width for one in self.inputs)]).tolist()
        return tuple(slice(start, end) for start, end in pairwise(ends))

    @property
    def command_columns(self) -> tuple[slice, ...]:
        """The same of the outputs."""
        ends = np.cumsum([0, *(one.writer.width for one in self.outputs)]).tolist()
        return tuple(slice(start, end) for start, end in pairwise(ends))
