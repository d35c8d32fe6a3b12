"""What a client of Foxglove's WebSocket protocol receives of a node, and what it may send."""

import asyncio
import io
import socket
import sys
import threading
from collections.abc import Awaitable, Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from bhd_lerobot.errors import ConfigError
from bhd_lerobot.registry import ROBOTS
from bhd_lerobot.robots.config_turtlebot3 import TurtleBot3Config
from bhd_lerobot.ros2.live.network import LATCHED, NetworkConfig
from bhd_lerobot.ros2.messages.serialize import decode, encode
from bhd_lerobot.ros2.serve.config import ServeConfig
from bhd_lerobot.ros2.serve.foxglove import FoxgloveServer, MirroredNode
from bhd_lerobot.ros2.serve.serve import serve
from bhd_lerobot.ros2.serve.server import Counts, Input
from tests.ros2.serve.foxglove_client import Client
from tests.waiting import until

BOOL, TWIST, STAMPED = "std_msgs/msg/Bool", "geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped"
FORWARD = {"linear": {"x": 0.1}}
SENT: dict[str, tuple[str, dict[str, Any]]] = {
    "/scan": ("sensor_msgs/msg/LaserScan", {"ranges": np.array([0.5, np.inf, np.nan]), "range_max": 3.5}),
    "/odom": ("nav_msgs/msg/Odometry", {"header": {"frame_id": "odom"}, "twist": {"twist": FORWARD}}),
    "/tf": ("tf2_msgs/msg/TFMessage", {"transforms": [{"child_frame_id": "tool"}, {"child_frame_id": "b"}]}),
    "/image": ("sensor_msgs/msg/CompressedImage", {"format": "jpeg", "data": np.arange(200, dtype=np.uint8)}),
    "/cerebellum/state": ("bhd_interfaces/msg/CerebellumState", {"joint_positions": np.arange(7.0), "is_moving": True}),
}


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


@pytest.fixture
def port() -> int:
    return free_port()


@pytest.fixture
def foxglove(port: int) -> Iterator[FoxgloveServer]:
    server = FoxgloveServer("robot", port)
    yield server
    server.close()


@pytest.fixture
def node(domain: int, foxglove: FoxgloveServer) -> Iterator[MirroredNode]:
    with MirroredNode("robot", NetworkConfig(domain=domain), "/", foxglove) as made:
        yield made


def as_plain(message: Any) -> Any:
    """Return a message of either library as values that can be compared."""
    if hasattr(message, "__slots__") or hasattr(message, "__dataclass_fields__"):
        names = getattr(message, "__dataclass_fields__", None) or message.__slots__
        return {name: as_plain(getattr(message, name)) for name in names if name not in ("__msgtype__", "_type")}
    if isinstance(message, list | tuple | np.ndarray | bytes | memoryview):
        return [as_plain(one) for one in message]
    return message if isinstance(message, str) else f"{float(message)!r}"


def test_a_client_receives_what_is_published_with_a_schema_that_others_decode(node, foxglove, port):
    publishers = {topic: node.publisher(topic, msgtype) for topic, (msgtype, _) in SENT.items()}
    messages = {topic: encode(msgtype, fields, 1)[0] for topic, (msgtype, fields) in SENT.items()}
    foxglove.start()

    async def scenario() -> None:
        async with Client(port) as client:
            await client.until(lambda: all(one.receivers for one in publishers.values()))
            for topic, publisher in publishers.items():
                publisher.send(messages[topic])
            await client.until(lambda: all(client.messages[topic] for topic in SENT))
            for topic, (msgtype, _) in SENT.items():
                schema = client.schemas[topic]
                assert (schema.name, schema.encoding) == (msgtype, "ros2msg")
                [received] = client.messages[topic]  # by mcap-ros2-support
                assert as_plain(received) == as_plain(decode(msgtype, messages[topic])), topic

    asyncio.run(scenario())


def test_who_comes_later_receives_what_is_latched_and_nothing_else(node, foxglove, port):
    latched, other = node.publisher("/latched", BOOL, LATCHED), node.publisher("/other", BOOL)
    for publisher in (latched, other):
        publisher.send(encode(BOOL, {"data": True}, 1)[0])
    foxglove.start()

    async def scenario() -> None:
        for _ in range(2):
            async with Client(port) as client:
                await client.until(lambda: client.messages.get("/latched"))
                await client.until(lambda: other.receivers)
                other.send(encode(BOOL, {"data": False}, 1)[0])
                await client.until(lambda: client.messages["/other"])
                assert [one.data for one in client.messages["/other"]] == [False]
                assert [one.data for one in client.messages["/latched"]] == [True]
            while other.receivers:
                await asyncio.sleep(0.002)

    asyncio.run(scenario())


GOOD, STAMPED_GOOD = encode(TWIST, FORWARD, 1)[0], encode(STAMPED, {"twist": FORWARD}, 1)[0]
SPOILT = {
    "too short": (STAMPED, GOOD[:11], "cdr", "cannot be read"),
    "empty": (STAMPED, b"", "cdr", "not serialised as plain CDR"),
    "no CDR": (STAMPED, b"\x07\x07" + STAMPED_GOOD[2:], "cdr", "not serialised as plain CDR"),
    "another type": (BOOL, encode(BOOL, {"data": True}, 1)[0], "cdr", "'std_msgs/msg/Bool' with the encoding 'cdr'"),
    "no type": ("", STAMPED_GOOD, "cdr", "'' with the encoding 'cdr'"),
    "another encoding": (STAMPED, b"{}", "json", "'geometry_msgs/msg/TwistStamped' with the encoding 'json'"),
}


def test_what_a_client_publishes_is_taken_by_the_topics_input_or_refused_and_counted(node, foxglove, port):
    taken: list[float] = []
    counts = Counts()
    entries = [
        Input(
            node.subscription("/cmd_vel", msgtype),
            lambda message: taken.append(getattr(message, "twist", message).linear.x),
            "each",
        )
        for msgtype in (STAMPED, TWIST)
    ]
    foxglove.start()

    def arrived() -> bool:
        for entry in entries:
            entry.run(counts)
        return bool(taken or counts.refused)

    async def scenario() -> None:
        async with Client(port) as client:
            for msgtype in (STAMPED, TWIST, "geometry_msgs/Twist"):  # the panel Teleop has no stamped twist
                await client.publish("/cmd_vel", msgtype, STAMPED_GOOD if msgtype == STAMPED else GOOD)
                await client.until(arrived)
                assert (taken, counts.refused) == ([0.1], {}), msgtype
                taken.clear()
        for name, (msgtype, data, encoding, why) in SPOILT.items():
            async with Client(port) as client:
                await client.publish("/cmd_vel", msgtype, data, encoding)
                await client.until(arrived)
                [(reason, count)] = counts.refused.items()
                assert reason.startswith("/cmd_vel: "), name
                assert why in reason, name
                assert (count, taken) == (1, []), name
                counts.refused.clear()

    asyncio.run(scenario())


def test_a_flood_waits_no_longer_than_the_newest_ten(node: MirroredNode, foxglove: FoxgloveServer, port: int) -> None:
    subscription = node.subscription("/flag", BOOL)
    foxglove.start()

    async def scenario() -> None:
        async with Client(port) as client:
            for number in range(500):
                await client.publish("/flag", BOOL, encode(BOOL, {"data": number == 499}, 1)[0])
            await client.publish("/none", BOOL, b"")  # its answer comes after all of them were taken
            await client.until(lambda: client.notices)
            assert client.notices == ["The robot does not subscribe to /none; it subscribes to: /flag."]
            assert [one.message().data for one in subscription.take()] == [False] * 9 + [True]

    asyncio.run(scenario())


def test_a_port_in_use_is_named_with_the_remedy(foxglove: FoxgloveServer, port: int) -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", port))
        other.listen()
        with pytest.raises(ConfigError, match=rf"--foxglove_port={port}: .*in use.*Choose another port, .*8766"):
            foxglove.start()


def test_what_cannot_be_served_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "foxglove", None)
    with pytest.raises(ConfigError, match="--foxglove_port=8765 needs the package foxglove-sdk"):
        FoxgloveServer("robot", 8765)


def served(config: ServeConfig, scenario: Callable[[Any, io.StringIO], Awaitable[None]]) -> None:
    """Serve a robot until a client has done what it does; `scenario` takes the client and what was printed."""
    printed, ended = io.StringIO(), threading.Event()

    async def connected() -> None:
        async with Client(config.foxglove_port) as client:
            await scenario(client, printed)

    def run() -> None:
        try:
            until(lambda: "Open connection" in printed.getvalue() or ended.is_set(), "it is served")
            asyncio.run(connected())
        finally:
            ended.set()

    with ThreadPoolExecutor(1) as pool:
        client = pool.submit(run)
        try:
            serve(config, ROBOTS.of(config.robot), Console(file=printed, width=1000), ended)
        finally:
            ended.set()
        client.result()


def test_a_client_drives_a_base_and_stops_it(domain: int, port: int) -> None:
    async def scenario(client: Any, printed: io.StringIO) -> None:
        def x(pose: Any) -> float:
            where: float = pose.pose.position.x
            return where

        await client.until(lambda: client.messages.get("/odom"))
        odometry, paths = client.messages["/odom"], client.messages["/cerebellum/path"]
        start = x(odometry[-1].pose)
        while x(odometry[-1].pose) < start + 0.03:
            await client.publish("/cmd_vel", TWIST, GOOD)
            await client.receive()
        await client.until(lambda: paths and x(paths[-1].poses[-1]) > start + 0.02)
        assert paths[-1].header.frame_id == "odom"
        assert abs(x(paths[-1].poses[0]) - start) < 0.01

        await client.publish("/cmd_vel", TWIST, GOOD[:9])
        await client.until(lambda: "refused 1: /cmd_vel: A message of 9 bytes" in printed.getvalue())

        await client.publish("/emergency_stop", BOOL, encode(BOOL, {"data": True}, 1)[0])
        await client.until(lambda: client.messages["/cerebellum/state"][-1].emergency_stop)
        await client.publish("/cmd_vel", TWIST, GOOD)
        await client.until(lambda: "/cmd_vel: the emergency stop" in printed.getvalue())

    network = NetworkConfig(domain=domain)
    served(ServeConfig(robot=TurtleBot3Config(), network=network, foxglove_port=port), scenario)
