"""A client of Foxglove's WebSocket protocol, independent of its SDK, that is subscribed to all topics."""

import json
import struct
from collections.abc import Callable
from types import TracebackType
from typing import Any, Self

import aiohttp
from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory


class Client:
    """A client."""

    def __init__(self, port: int) -> None:
        self._url = f"ws://127.0.0.1:{port}"
        self.schemas: dict[str, Schema] = {}
        self.messages: dict[str, list[Any]] = {}
        self.notices: list[str] = []
        self._topics: dict[int, tuple[str, Callable[[bytes], Any]]] = {}
        self._published: dict[tuple[str, str], int] = {}

    async def __aenter__(self) -> Self:
        self._session = aiohttp.ClientSession()
        self._socket = await self._session.ws_connect(self._url, protocols=["foxglove.sdk.v1"], max_msg_size=0)
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self._socket.close()
        await self._session.close()

    async def receive(self, timeout_s: float = 0.01) -> None:
        """Take what comes next, if it comes in time."""
        try:
            received = await self._socket.receive(timeout_s)
        except TimeoutError:
            return
        if received.type == aiohttp.WSMsgType.BINARY:
            topic, decode = self._topics[struct.unpack_from("<I", received.data, 1)[0]]
            self.messages[topic].append(decode(received.data[13:]))
            return
        assert received.type == aiohttp.WSMsgType.TEXT, "the server has closed the connection"
        content = json.loads(received.data)
        if content["op"] == "advertise":
            await self._subscribe(content["channels"])
        elif content["op"] == "status":
            self.notices.append(content["message"])

    async def until(self, condition: Callable[[], Any]) -> None:
        """Take what comes until a condition holds."""
        while not condition():
            await self.receive()

    async def _subscribe(self, channels: list[dict[str, Any]]) -> None:
        for channel in channels:
            name, encoding = channel["schemaName"], channel["schemaEncoding"]
            schema = Schema(id=channel["id"], name=name, encoding=encoding, data=channel["schema"].encode())
            decode = DecoderFactory().decoder_for(channel["encoding"], schema)
            assert decode is not None, channel["topic"]
            self.schemas[channel["topic"]] = schema
            self.messages[channel["topic"]] = []
            self._topics[channel["id"]] = channel["topic"], decode
        wanted = [{"id": channel["id"], "channelId": channel["id"]} for channel in channels]
        await self._socket.send_json({"op": "subscribe", "subscriptions": wanted})

    async def publish(self, topic: str, msgtype: str, data: bytes, encoding: str = "cdr") -> None:
        """Publish a serialised message."""
        number = self._published.get((topic, msgtype))
        if number is None:
            number = self._published[topic, msgtype] = len(self._published) + 1
            channel = {"id": number, "topic": topic, "encoding": encoding, "schemaName": msgtype}
            await self._socket.send_json({"op": "advertise", "channels": [channel]})
        await self._socket.send_bytes(struct.pack("<BI", 1, number) + data)
