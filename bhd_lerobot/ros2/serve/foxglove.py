"""Foxglove beside the network: a WebSocket server, by Foxglove's SDK, for what a node publishes and subscribes to.

What a client publishes is taken by the same inputs as what comes from the network.
"""

import logging
import time
from collections import deque
from dataclasses import dataclass
from typing import Any, override

from bhd_lerobot.errors import ConfigError, DatasetError, as_text
from bhd_lerobot.ros2.live.network import NetworkConfig, Qos
from bhd_lerobot.ros2.live.node import MOST_TAKEN, Node, Publisher, Received, Subscription
from bhd_lerobot.ros2.messages.types import type_store

HOST = "127.0.0.1"
_ENCODING = "cdr"


@dataclass(frozen=True)
class _Refused(Received):
    """A client's message that is not of the topic's type."""

    why: str = ""

    @override
    def message(self) -> Any:
        raise DatasetError(self.why)


class FoxgloveServer:
    """Serves topics to the Foxglove app, on this machine alone: ``ws://localhost:PORT``.

    Raises:
        ConfigError: Foxglove's SDK is not installed.
    """

    def __init__(self, name: str, port: int) -> None:
        try:
            import foxglove
        except ImportError as error:
            raise ConfigError(
                f"--foxglove_port={port} needs the package foxglove-sdk, which cannot be imported ({error}). Install "
                "it: uv pip install foxglove-sdk. 0 turns Foxglove off."
            ) from error
        self._sdk, self._context = foxglove, foxglove.Context()
        self._latched: dict[str, MirroredPublisher] = {}
        self._inboxes: dict[str, dict[str, deque[Received]]] = {}  # what waits, by topic and type
        self._advertised: dict[tuple[int, int], Any] = {}  # clients' channels
        self._warned: set[tuple[int, int]] = set()
        self._name, self._port = name, port
        self._server: Any = None

    def start(self) -> None:
        """Let clients connect, when all topics are there: the SDK announces one before it takes subscriptions to it.

        Raises:
            ConfigError: the port cannot be used.
        """
        logging.getLogger("foxglove.websocket").setLevel(logging.CRITICAL)  # a client that goes away is no error
        try:
            self._server = self._sdk.start_server(
                name=self._name,
                host=HOST,
                port=self._port,
                capabilities=[self._sdk.Capability.ClientPublish],
                supported_encodings=[_ENCODING],
                server_listener=self,  # type: ignore[arg-type]  # it calls what its capabilities need
                context=self._context,
            )
        except RuntimeError as error:
            raise ConfigError(
                f"--foxglove_port={self._port}: Foxglove cannot be served on {HOST}: {as_text(error)}. Choose another "
                "port, for example 8766, or end the program that uses it; 0 turns Foxglove off."
            ) from error

    def channel(self, topic: str, msgtype: str) -> Any:
        """Return a channel of the SDK for serialised messages of a type."""
        text, _ = type_store().generate_msgdef(msgtype, ros_version=2)
        schema = self._sdk.Schema(name=msgtype, encoding="ros2msg", data=text.encode())
        return self._sdk.Channel(topic, schema=schema, message_encoding=_ENCODING, context=self._context)

    def keep_last(self, topic: str, publisher: "MirroredPublisher") -> None:
        """Send a client that subscribes to a topic later the last message that was published on it."""
        self._latched[topic] = publisher

    def inbox(self, topic: str, msgtype: str, depth: int) -> deque[Received]:
        """Return where the messages that clients publish on a topic are put; a depth of 0 keeps all."""
        return self._inboxes.setdefault(topic, {}).setdefault(msgtype, deque(maxlen=depth or None))

    def close(self) -> None:
        """Disconnect the clients. May be called twice."""
        if self._server is not None:
            self._server.stop()

    # --- called by the SDK, on threads of its own --------------------------------------------------------------------

    def on_subscribe(self, client: Any, channel: Any) -> None:
        """Send what is latched."""
        publisher = self._latched.get(channel.topic)
        if publisher is not None:
            publisher.send_last()

    def on_unsubscribe(self, client: Any, channel: Any) -> None:
        """Do nothing: the SDK knows who is subscribed."""

    def on_client_advertise(self, client: Any, channel: Any) -> None:
        """Note what a client is going to publish."""
        self._advertised[client.id, channel.id] = channel

    def on_client_unadvertise(self, client: Any, client_channel_id: int) -> None:
        """Forget it."""
        self._advertised.pop((client.id, client_channel_id), None)
        self._warned.discard((client.id, client_channel_id))

    def on_message_data(self, client: Any, client_channel_id: int, data: bytes) -> None:
        """Put a message where the topic's input takes it."""
        key = client.id, client_channel_id
        channel = self._advertised.get(key)
        if channel is None:  # not advertised any more
            return
        if channel.topic not in self._inboxes:
            takes = ", ".join(sorted(self._inboxes))
            self._warn(key, f"The robot does not subscribe to {channel.topic}; it subscribes to: {takes}.")
            return
        inboxes = self._inboxes[channel.topic]
        package, _, name = (channel.schema_name or "").rpartition("/")
        given = f"{package.removesuffix('/msg')}/msg/{name}"
        times = time.time_ns(), time.monotonic_ns()
        if channel.encoding == _ENCODING and given in inboxes:
            inboxes[given].append(Received(given, bytes(data), *times))
            return
        why = (
            f"A client of Foxglove publishes {channel.schema_name!r} with the encoding {channel.encoding!r}; the topic "
            f"takes {' or '.join(inboxes)} with {_ENCODING!r}."
        )
        self._warn(key, f"{channel.topic}: {why}")
        next(iter(inboxes.values())).append(_Refused(given, b"", *times, why=why))

    def _warn(self, key: tuple[int, int], message: str) -> None:
        """Show a message in the app, once for each of a client's channels."""
        if key not in self._warned:
            self._warned.add(key)
            self._server.publish_status(message, self._sdk.StatusLevel.Error)


class MirroredPublisher(Publisher):
    """A publisher whose messages are also sent to clients of Foxglove that are subscribed."""

    def __init__(self, writer: Any, made: Any, topic: str, msgtype: str, channel: Any) -> None:
        super().__init__(writer, made, topic, msgtype)
        self._channel = channel
        self._last = b""

    @override
    def send(self, data: bytes) -> None:
        super().send(data)
        self._last = data
        if self._channel.has_sinks():
            self._channel.log(data)

    def send_last(self) -> None:
        """Send clients of Foxglove the last message again, on any thread."""
        sent = b""
        while sent is not self._last:  # a newer one may have come meanwhile
            sent = self._last
            self._channel.log(sent)

    @property
    @override
    def receivers(self) -> int:
        return super().receivers + self._channel.has_sinks()


class MirroredSubscription(Subscription):
    """A subscription that also receives what clients of Foxglove publish."""

    def __init__(self, reader: Any, topic: str, msgtype: str, inbox: deque[Received]) -> None:
        super().__init__(reader, topic, msgtype)
        self._inbox = inbox

    @override
    def take(self, most: int = MOST_TAKEN) -> list[Received]:
        """Return what has arrived since the last call: clients' messages, then those of the network."""
        clients = [self._inbox.popleft() for _ in range(min(len(self._inbox), most))]
        return clients + (super().take(most - len(clients)) if len(clients) < most else [])


class MirroredNode(Node):
    """A node whose topics are also served to the Foxglove app."""

    def __init__(self, name: str, network: NetworkConfig, namespace: str, server: FoxgloveServer) -> None:
        super().__init__(name, network, namespace)
        self._server = server

    @override
    def publisher(self, topic: str, msgtype: str, qos: Qos | None = None) -> Publisher:
        qos, name = qos or Qos(), self.full_name(topic)
        channel = self._server.channel(name, msgtype)
        publisher = MirroredPublisher(*self._writer(f"rt{name}", msgtype, qos), topic, msgtype, channel)
        if qos.transient_local:
            self._server.keep_last(name, publisher)
        return publisher

    @override
    def subscription(self, topic: str, msgtype: str, qos: Qos | None = None) -> Subscription:
        qos, name = qos or Qos(), self.full_name(topic)
        reader = self._reader(f"rt{name}", msgtype, qos)
        return MirroredSubscription(reader, topic, msgtype, self._server.inbox(name, msgtype, qos.depth))
