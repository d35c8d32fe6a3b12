"""A ROS 2 node: publishers and subscriptions on serialised messages."""

import os
import socket
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any, Self

from bhd_lerobot.errors import RealtimeError, as_text
from bhd_lerobot.ros2.live.graph import Graph
from bhd_lerobot.ros2.live.network import NetworkConfig, Qos, require_cyclonedds
from bhd_lerobot.ros2.live.topic_types import raw, sample_class
from bhd_lerobot.ros2.messages.definitions import find_type
from bhd_lerobot.ros2.messages.serialize import decode
from bhd_lerobot.ros2.messages.types import type_store

_PORT, _PORTS = 7400, 250  # DDS: of domain 0, and from one domain to the next
MOST_TAKEN = 1000  # messages that are taken at once


@dataclass(frozen=True)
class Received:
    """A message that arrived.

    Attributes:
        sent_ns: when it was sent, on the sender's wall clock [ns].
        arrived_ns: when it was taken, on the monotonic clock of this machine [ns].
    """

    msgtype: str
    data: bytes
    sent_ns: int
    arrived_ns: int
    sender: int = field(default=0, kw_only=True)

    def message(self) -> Any:
        """Return it deserialised."""
        return decode(self.msgtype, self.data)


class Publisher:
    """Sends messages of a type on a topic."""

    def __init__(self, writer: Any, made: Any, topic: str, msgtype: str) -> None:
        self._writer, self._made, self.topic, self.msgtype = writer, made, topic, msgtype

    def send(self, data: bytes) -> None:
        """Send a serialised message.

        Raises:
            RealtimeError: Cyclone DDS does not take it.
        """
        from cyclonedds.core import DDSException

        try:
            self._writer.write(raw(self._made, data))
        except DDSException as error:
            raise RealtimeError(f"A message for {self.topic} cannot be sent: {as_text(error)}.") from error

    def wait_for_acks(self, timeout_s: float) -> bool:
        """Wait until all reliable subscriptions have received everything, or a time is over [s]; return which."""
        from cyclonedds.core import DDSException

        try:
            return bool(self._writer.wait_for_acks(round(timeout_s * 1e9)))
        except (DDSException, AttributeError):  # the second at a time-out, which Cyclone DDS 11.0.1 looks up wrongly
            return False

    @property
    def receivers(self) -> int:
        """How many subscriptions fit, of any node."""
        return len(_matched(self._writer.get_matched_subscriptions))


class Subscription:
    """Receives messages of a type on a topic."""

    def __init__(self, reader: Any, topic: str, msgtype: str) -> None:
        self.reader, self.topic, self.msgtype = reader, topic, msgtype

    def take(self, most: int = MOST_TAKEN) -> list[Received]:
        """Return what has arrived since the last call, oldest first; what is beyond `most` stays for the next call."""
        samples = self.reader.take(most)
        now = time.monotonic_ns()
        return [
            Received(self.msgtype, sample.data, info.source_timestamp, now, sender=info.publication_handle)
            for sample in samples
            if (info := sample.sample_info).valid_data
        ]

    @property
    def senders(self) -> int:
        """How many publishers fit, of any node; one that was killed counts for up to 20 s more."""
        return len(self.sender_ids)

    @property
    def sender_ids(self) -> list[int]:
        """The publishers that fit."""
        # Cyclone DDS returns them signed here, and unsigned with a sample (11.0.1).
        return [handle % 2**64 for handle in _matched(self.reader.get_matched_publications)]


def _matched(ask: Callable[[], list[int]]) -> list[int]:
    """Return the other ends: Cyclone DDS (11.0.1) counts them first, and fails if one more fits before it lists."""
    while True:
        with suppress(IndexError):
            return ask()


class Node:
    """A node on the network, which `ros2 node list` shows.

    Args:
        namespace: the node's; topics without a slash in front are in it.

    Raises:
        ConfigError: Cyclone DDS is not installed.
        RealtimeError: the network cannot be used.
    """

    def __init__(self, name: str, network: NetworkConfig, namespace: str = "/") -> None:
        require_cyclonedds()
        from cyclonedds.core import DDSException, WaitSet
        from cyclonedds.domain import Domain, DomainParticipant
        from cyclonedds.qos import Policy
        from cyclonedds.qos import Qos as DdsQos

        self.name, self.namespace, self.network = name, "/" + namespace.strip("/"), network
        try:
            self._domain = Domain(network.domain_number, network.cyclonedds_xml())
            if network.is_local:
                _keep_local(network.domain_number)
            self._participant = DomainParticipant(network.domain_number, DdsQos(Policy.Userdata(b"enclave=/;")))
        except DDSException as error:
            raise RealtimeError(
                f"The network interface {network.interface!r} cannot be used for ROS domain {network.domain_number}: "
                f"{as_text(error)}. `ip address` lists the interfaces."
            ) from error
        self._waiting = WaitSet(self._participant)
        self._entities: list[Any] = []
        self.graph = Graph(self._participant, self.name, self.namespace, network.distro)

    def full_name(self, topic: str) -> str:
        """Return a topic's name with the namespace in front, unless it begins with a slash."""
        return topic if topic.startswith("/") else f"{self.namespace.rstrip('/')}/{topic}"

    def publisher(self, topic: str, msgtype: str, qos: Qos | None = None) -> Publisher:
        """Return a publisher."""
        return Publisher(*self._writer(f"rt{self.full_name(topic)}", msgtype, qos or Qos()), topic, msgtype)

    def subscription(self, topic: str, msgtype: str, qos: Qos | None = None) -> Subscription:
        """Return a subscription."""
        return Subscription(self._reader(f"rt{self.full_name(topic)}", msgtype, qos or Qos()), topic, msgtype)

    def raw_publisher(self, name: str, msgtype: str) -> Publisher:
        """Return a publisher by its name on the network, as of a service's requests."""
        return Publisher(*self._writer(name, msgtype, Qos()), name, msgtype)

    def raw_subscription(self, name: str, msgtype: str, qos: Qos) -> Subscription:
        """Return a subscription by its name on the network, whose messages do not end `wait`."""
        return Subscription(self._reader(name, msgtype, qos, wakes=False), name, msgtype)

    def remove(self, subscription: Subscription) -> None:
        """End a raw subscription; it must not be used any more."""
        self._entities.remove(subscription.reader)
        self.graph.remove(subscription.reader.guid, is_writer=False)
        subscription.reader = None

    def wait(self, timeout_s: float) -> None:
        """Return when a message has arrived on a subscription, or after a time [s]."""
        self._waiting.wait(max(1, round(timeout_s * 1e9)))

    def _topic(self, name: str, msgtype: str) -> Any:
        from cyclonedds.topic import Topic

        find_type(msgtype, self.network.distro)
        topic = Topic(self._participant, name, sample_class(msgtype))
        self._entities.append(topic)
        return topic

    def _writer(self, name: str, msgtype: str, qos: Qos) -> tuple[Any, Any]:
        from cyclonedds.pub import DataWriter

        writer = DataWriter(self._participant, self._topic(name, msgtype), qos.of_dds(_type_hash(msgtype)))
        self._entities.append(writer)
        self.graph.add(writer.guid, is_writer=True)
        return writer, sample_class(msgtype)

    def _reader(self, name: str, msgtype: str, qos: Qos, *, wakes: bool = True) -> Any:
        from cyclonedds.core import InstanceState, ReadCondition, SampleState, ViewState
        from cyclonedds.sub import DataReader

        reader = DataReader(self._participant, self._topic(name, msgtype), qos.of_dds(_type_hash(msgtype)))
        self._entities.append(reader)
        if wakes:
            anything = ReadCondition(reader, ViewState.Any | InstanceState.Any | SampleState.NotRead)
            self._waiting.attach(anything)
            self._entities.append(anything)
        self.graph.add(reader.guid, is_writer=False)
        return reader

    def close(self) -> None:
        """Leave the network. May be called twice."""
        # Cyclone DDS deletes an entity with the last reference to it; the domain's participant has to go first.
        self._entities.clear()
        self.__dict__.pop("_waiting", None)
        self.__dict__.pop("graph", None)
        self.__dict__.pop("_participant", None)
        self.__dict__.pop("_domain", None)

    def __enter__(self) -> Self:
        """Return the node."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Leave the network."""
        self.close()


def _keep_local(domain: int) -> None:
    """Have the sockets of a domain receive from the loopback device only: Cyclone DDS binds them to all addresses."""
    if not hasattr(socket, "SO_BINDTODEVICE"):  # Linux has it, since 5.7 for every user
        return
    first = _PORT + _PORTS * domain
    for number in os.listdir("/proc/self/fd"):
        try:
            if not os.readlink(f"/proc/self/fd/{number}").startswith("socket:"):
                continue
            with socket.socket(fileno=os.dup(int(number))) as one:
                is_of_domain = one.type == socket.SOCK_DGRAM and one.family == socket.AF_INET
                if is_of_domain and first <= one.getsockname()[1] < first + _PORTS:
                    one.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, b"lo\0")
        except OSError:  # closed meanwhile, or not permitted
            continue


def _type_hash(msgtype: str) -> bytes:
    """Return what an endpoint says of its type since Iron; ROS 2 warns of an endpoint without it."""
    return f"typehash={type_store().hash_rihs01(msgtype)};".encode()
