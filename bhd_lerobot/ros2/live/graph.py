"""Which nodes, publishers and subscriptions are on the network, and what does not fit together."""

import re
import threading
from collections.abc import Collection
from dataclasses import dataclass
from importlib import import_module
from typing import Any
from uuid import UUID

from bhd_lerobot.ros2.live.network import LATCHED, Qos
from bhd_lerobot.ros2.live.topic_types import ros_type_name

_GID_BYTES = {"humble": 24}  # 16 since Iron
_TOPICS, _REQUESTS = "rt", "rq"  # what names of topics and of requests to services begin with
_MOST = 10_000
UNNAMED = "an unnamed node"


@dataclass(frozen=True)
class Endpoint:
    """A publisher or a subscription.

    Attributes:
        node: name of its node with its namespace; empty while that is not known.
        type_hash: of the type's definition, as ROS 2 states it since Iron; empty if it does not.
    """

    topic: str
    msgtype: str
    qos: Qos
    is_publisher: bool
    node: str
    is_own: bool
    type_hash: str = ""


class Graph:
    """The nodes on the network.

    ROS 2's nodes share a participant with others of their process, and tell which endpoints are theirs on
    ``ros_discovery_info``.
    """

    def __init__(self, participant: Any, name: str, namespace: str, distro: str) -> None:
        from cyclonedds.builtin import (
            BuiltinDataReader,
            BuiltinTopicDcpsParticipant,
            BuiltinTopicDcpsPublication,
            BuiltinTopicDcpsSubscription,
        )
        from cyclonedds.pub import DataWriter
        from cyclonedds.sub import DataReader
        from cyclonedds.topic import Topic

        self._name, self._namespace = name, namespace
        self._gid_bytes = _GID_BYTES.get(distro, 16)
        self._participant_guid: UUID = participant.guid
        self._gid, self._node, self._info = _types(self._gid_bytes)
        topic = Topic(participant, "ros_discovery_info", self._info)
        self._writer = DataWriter(participant, topic, LATCHED.of_dds())
        self._reader = DataReader(participant, topic, Qos(100, transient_local=True).of_dds())
        self._endpoints = {
            is_publisher: _Present(BuiltinDataReader(participant, kind))
            for is_publisher, kind in (
                (True, BuiltinTopicDcpsPublication),
                (False, BuiltinTopicDcpsSubscription),
            )
        }
        self._participants = _Present(BuiltinDataReader(participant, BuiltinTopicDcpsParticipant))
        self._own: dict[bool, list[UUID]] = {True: [], False: []}
        self._owners: dict[bytes, dict[bytes, str]] = {}  # participant -> endpoint -> node
        self._nodes: dict[bytes, list[str]] = {}
        self._lock = threading.Lock()
        self._publish()

    def add(self, guid: UUID, *, is_writer: bool) -> None:
        """Publish that an endpoint is this node's."""
        self._own[is_writer].append(guid)
        self._publish()

    def remove(self, guid: UUID, *, is_writer: bool) -> None:
        """Publish that an endpoint is this node's no longer."""
        self._own[is_writer].remove(guid)
        self._publish()

    def _publish(self) -> None:
        readers, writers = ([self._gid_of(guid) for guid in self._own[kind]] for kind in (False, True))
        node = self._node(self._namespace, self._name, readers, writers)
        self._writer.write(self._info(self._gid_of(self._participant_guid), [node]))

    def _gid_of(self, guid: UUID) -> Any:
        return self._gid(list(guid.bytes.ljust(self._gid_bytes, b"\0")))

    def nodes(self) -> list[str]:
        """Return the names of all nodes with their namespaces, sorted; several of one name are listed as often."""
        with self._lock:
            self._update()
            return sorted(name for names in self._nodes.values() for name in names)

    def endpoints(self, prefix: str = _TOPICS) -> list[Endpoint]:
        """Return all publishers and subscriptions of topics, sorted by topic; with another prefix, of services."""
        with self._lock:
            self._update()
            owners = {gid: name for owned in self._owners.values() for gid, name in owned.items()}
            found = []
            for is_publisher, present in self._endpoints.items():
                for one in present.samples():
                    if not one.topic_name.startswith(f"{prefix}/"):
                        continue
                    found.append(
                        Endpoint(
                            one.topic_name.removeprefix(prefix),
                            ros_type_name(one.type_name),
                            _qos_of(one.qos),
                            is_publisher,
                            owners.get(one.key.bytes, ""),
                            one.participant_key == self._participant_guid,
                            _type_hash_of(one.qos),
                        )
                    )
        return sorted(found, key=lambda one: (one.topic, not one.is_publisher, one.node))

    def services(self) -> dict[str, str]:
        """Return the types of all services that have a server, by name, sorted."""
        return {
            one.topic.removesuffix("Request"): one.msgtype.removesuffix("_Request")
            for one in self.endpoints(_REQUESTS)
            if not one.is_publisher
        }

    def _update(self) -> None:
        for sample in self._reader.take(_MOST):
            if not hasattr(sample, "gid"):
                continue  # a participant that has left
            key = bytes(sample.gid.data)[:16]
            named = {_full_name(node): node for node in sample.node_entities_info_seq}
            self._nodes[key] = [_full_name(node) for node in sample.node_entities_info_seq]
            self._owners[key] = {
                bytes(gid.data)[:16]: name
                for name, node in named.items()
                for gid in (*node.reader_gid_seq, *node.writer_gid_seq)
            }
        alive = {one.key.bytes for one in self._participants.samples()}
        for key in [key for key in self._nodes if key not in alive]:
            del self._nodes[key], self._owners[key]

    def mismatches(self, topic: str, msgtype: str, qos: Qos, *, is_publisher: bool) -> list[str]:
        """Return why endpoints of others on a topic do not exchange messages with one of ours, in sentences."""
        return _mismatches(Endpoint(topic, msgtype, qos, is_publisher, "", is_own=True), self.endpoints())

    def all_mismatches(self) -> list[str]:
        """Return the same for all topics of this process, to which others adapt, with the remedy."""
        everyone = self.endpoints()
        texts: list[str] = []
        for other in everyone:
            # A topic may have several subscriptions here, of several types, one of which fits.
            own = [one for one in everyone if one.is_own and _meets(one, other)]
            found = [_mismatches(one, [other]) for one in own if one.msgtype == other.msgtype]
            found = found or [_mismatches(one, [other]) for one in own]
            texts += [f"{text} Give it the same type and QoS." for text in found[0]] if found and all(found) else []
        return texts

    def rivals(self, topics: Collection[str]) -> list[str]:
        """Return which of some topics several publishers of others send on, in sentences."""
        senders: dict[str, list[str]] = {}
        for one in self.endpoints():
            if one.topic in topics and one.is_publisher and not one.is_own:
                senders.setdefault(one.topic, []).append(one.node.lstrip("/") or UNNAMED)
        for nodes in senders.values():  # a robot's node and its guard are one
            nodes[:] = [name for name in nodes if not (name.endswith("_guard") and name[: -len("_guard")] in nodes)]
        return [
            f"{topic} has {len(nodes)} publishers, {' and '.join(sorted(nodes))}: the newest message counts."
            for topic, nodes in sorted(senders.items())
            if len(nodes) > 1
        ]

    def doubles(self) -> list[str]:
        """Return which other nodes are the same robot as this one, in sentences.

        They subscribe to a topic that this node subscribes to, and publish one that it publishes: both obey.
        """
        everyone = self.endpoints()
        own = {(one.topic, one.is_publisher) for one in everyone if one.is_own and one.topic not in _SHARED}
        shared: dict[str, dict[bool, set[str]]] = {}
        for one in everyone:
            if not one.is_own and one.node and (one.topic, one.is_publisher) in own:
                shared.setdefault(one.node, {True: set(), False: set()})[one.is_publisher].add(one.topic)
        return [
            f"Another node, {node}, subscribes to {', '.join(sorted(found[False]))} and publishes "
            f"{', '.join(sorted(found[True])[:3])}, too: both robots obey the same commands. Give one of them another "
            "--network.domain. A node that was killed is there for up to 20 s more."
            for node, found in sorted(shared.items())
            if found[True] and found[False]
        ]


_SHARED = ("/tf", "/tf_static", "/diagnostics", "/clock", "/rosout", "/parameter_events")  # of any number of publishers


def _meets(ours: Endpoint, other: Endpoint) -> bool:
    return not other.is_own and other.topic == ours.topic and other.is_publisher != ours.is_publisher


def _mismatches(ours: Endpoint, everyone: list[Endpoint]) -> list[str]:
    kinds = ("publisher", "subscription") if ours.is_publisher else ("subscription", "publisher")
    found = []
    for one in everyone:
        if not _meets(ours, one):
            continue
        who = f"The {kinds[1]} of {one.topic} in {one.node or UNNAMED}"
        if one.msgtype != ours.msgtype:
            found.append(f"{who} is of type {one.msgtype}; the {kinds[0]} here is of {ours.msgtype}.")
        else:
            offered, wanted = (ours.qos, one.qos) if ours.is_publisher else (one.qos, ours.qos)
            if not offered.serves(wanted):
                found.append(f"{who} is {one.qos}; the {kinds[0]} here is {ours.qos}, and no message passes.")
    return found


class _Present:
    """What there is by a built-in topic, of which changes alone are read: a sample costs 0.3 ms."""

    def __init__(self, reader: Any) -> None:
        self._reader = reader
        self._samples: dict[int, Any] = {}

    def samples(self) -> list[Any]:
        """Return the samples of all that are there now."""
        from cyclonedds.core import InstanceState

        for one in self._reader.take(_MOST):
            info = one.sample_info
            if info.valid_data and info.instance_state == InstanceState.Alive:
                self._samples[info.instance_handle] = one
            else:
                self._samples.pop(info.instance_handle, None)
        return list(self._samples.values())


def _full_name(node: Any) -> str:
    return f"{node.node_namespace.rstrip('/')}/{node.node_name}"


def _qos_of(qos: Any) -> Qos:
    from cyclonedds.qos import Policy

    history = next((policy for policy in qos if isinstance(policy, Policy.History.KeepLast)), None)
    return Qos(
        history.depth if history else 0,
        any(isinstance(policy, Policy.Reliability.Reliable) for policy in qos),
        any(policy is Policy.Durability.TransientLocal for policy in qos),
    )


def _type_hash_of(qos: Any) -> str:
    from cyclonedds.qos import Policy

    for policy in qos:
        if isinstance(policy, Policy.Userdata) and (found := re.search(rb"typehash=(RIHS01_[0-9a-f]+);", policy.data)):
            return found[1].decode()
    return ""


def _types(gid_bytes: int) -> tuple[Any, Any, Any]:
    from cyclonedds.idl import make_idl_struct

    idl: Any = import_module("cyclonedds.idl.types")
    package = "rmw_dds_common::msg::dds_::"
    gid: Any = make_idl_struct("Gid", f"{package}Gid_", {"data": idl.array[idl.uint8, gid_bytes]})
    text = idl.bounded_str[256]
    node: Any = make_idl_struct(
        "NodeEntitiesInfo",
        f"{package}NodeEntitiesInfo_",
        {
            "node_namespace": text,
            "node_name": text,
            "reader_gid_seq": idl.sequence[gid],
            "writer_gid_seq": idl.sequence[gid],
        },
    )
    info: Any = make_idl_struct(
        "ParticipantEntitiesInfo",
        f"{package}ParticipantEntitiesInfo_",
        {"gid": gid, "node_entities_info_seq": idl.sequence[node]},
    )
    return gid, node, info
