"""Nodes beside real ones of ROS 2, and what does not fit together."""

import contextlib
import os
import socket
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from bhd_lerobot.ros2.live.network import SENSOR_DATA, NetworkConfig, Qos
from bhd_lerobot.ros2.live.node import Node
from bhd_lerobot.ros2.messages.serialize import encode
from bhd_lerobot.ros2.messages.types import type_store
from tests.forks import Fork
from tests.ros2.peer_env import Peer
from tests.waiting import until

ODOMETRY, SCAN, IMU = "nav_msgs/msg/Odometry", "sensor_msgs/msg/LaserScan", "sensor_msgs/msg/Imu"


def test_a_real_node_is_heard_and_named_and_mismatches_are_said(domain: int) -> None:
    with Node("robot", NetworkConfig(domain)) as node, Peer("standin_turtlebot3.py", "--open", domain=domain) as peer:
        peer.wait_event("ready")
        scans = node.subscription("/scan", SCAN, SENSOR_DATA)
        received = until(scans.take, "a scan comes")
        assert abs(received[-1].sent_ns - time.time_ns()) < 60e9
        assert len(received[-1].message().ranges) == 360
        until(lambda: "/turtlebot3_node" in node.graph.nodes(), "the robot's node is named")
        assert "/robot" in node.graph.nodes()

        def mismatch(topic: str, msgtype: str, qos: Qos) -> str:
            return until(lambda: node.graph.mismatches(topic, msgtype, qos, is_publisher=False), "it is found")[0]

        assert "is best effort; the subscription here is reliable, and no message" in mismatch("/scan", SCAN, Qos())
        assert f"is of type {SCAN}; the subscription here is of {IMU}" in mismatch("/scan", IMU, SENSOR_DATA)
        assert not node.graph.mismatches("/odom", ODOMETRY, Qos(), is_publisher=False)
        stale = node.graph.mismatches("/cmd_vel", "geometry_msgs/msg/Twist", Qos(), is_publisher=True)
        assert "is of type geometry_msgs/msg/TwistStamped" in stale[0]


def test_a_real_node_lists_ours_and_receives_what_it_sends(domain: int) -> None:
    text = "a text"
    with Node("robot", NetworkConfig(domain)) as node:
        publisher = node.publisher("/words", "std_msgs/msg/String")
        [data] = encode("std_msgs/msg/String", {"data": text}, 1)
        with Peer("topic.py", "echo", "/words", "std_msgs/msg/String", domain=domain) as peer:
            until(lambda: [publisher.send(data), [line for line in peer.lines if text in str(line)]][1], "it arrives")
        with Peer("topic.py", "list", domain=domain) as peer:
            peer.wait(lambda line: "robot" in str(line) and "/words" in str(line), "the node")


def test_other_ends_are_counted_while_they_come_and_go(domain: int) -> None:
    with Node("robot", NetworkConfig(domain)) as node, ThreadPoolExecutor(1) as pool:
        publisher = node.publisher("/words", "std_msgs/msg/String")

        def come_and_go() -> None:
            for _ in range(100):
                for one in [node.raw_subscription("rt/words", publisher.msgtype, Qos()) for _ in range(20)]:
                    node.remove(one)

        done = pool.submit(come_and_go)
        while not done.done():
            assert publisher.receivers >= 0
        done.result()
        until(lambda: not publisher.receivers, "none is left")


@pytest.mark.skipif(not hasattr(socket, "SO_BINDTODEVICE"), reason="of Linux")
def test_what_is_local_receives_from_the_loopback_device_only(domain: int) -> None:
    def devices() -> dict[int, bytes]:
        """Return the device of each UDP socket of this process that is bound to all addresses, by its port."""
        found = {}
        for number in os.listdir("/proc/self/fd"):
            with contextlib.suppress(OSError), socket.socket(fileno=os.dup(int(number))) as one:
                if one.type == socket.SOCK_DGRAM and one.getsockname()[0] == "0.0.0.0":
                    name = one.getsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, 16)
                    found[one.getsockname()[1]] = name.rstrip(b"\0")
        return found

    before = devices()
    with Node("robot", NetworkConfig(domain)):
        opened = {port: name for port, name in devices().items() if port not in before}
    assert opened
    assert set(opened.values()) == {b"lo"}


TWIST, DIAGNOSTICS = "geometry_msgs/msg/Twist", "diagnostic_msgs/msg/DiagnosticArray"
TYPES = {"/cmd_vel": TWIST, "/odom": ODOMETRY, "/diagnostics": DIAGNOSTICS}
ROBOT = (("/cmd_vel",), ("/odom", "/diagnostics"))


def stand(domain: int, name: str, subscribed: tuple[str, ...], published: tuple[str, ...]) -> int:
    """Be a node, until killed."""
    with Node(name, NetworkConfig(domain)) as node:
        kept = [node.subscription(topic, TYPES[topic]) for topic in subscribed]
        kept += [node.publisher(topic, TYPES[topic]) for topic in published]  # type: ignore[misc]
        while kept:
            time.sleep(0.05)
    return 0


def test_another_robot_of_the_same_topics_is_named_and_a_recorder_or_a_brain_is_not(domain, tmp_path):
    with contextlib.ExitStack() as others, Node("robot", NetworkConfig(domain)) as node:

        def add(name: str, subscribed: tuple[str, ...], published: tuple[str, ...]) -> None:
            fork = Fork(stand, domain, name, subscribed, published, output=tmp_path / name)
            others.callback(fork.kill)

        kept = [node.subscription("/cmd_vel", TWIST), *(node.publisher(topic, TYPES[topic]) for topic in ROBOT[1])]
        add("brain", ("/odom",), ("/cmd_vel",))
        add("recorder", ("/cmd_vel", "/odom"), ("/diagnostics",))
        until(lambda: {"/brain", "/recorder"} <= {one.node for one in node.graph.endpoints()}, "they are found")
        time.sleep(0.5)
        assert node.graph.doubles() == []
        add("robot", *ROBOT)
        [text] = until(node.graph.doubles, "it is named")
        assert text.startswith(
            "Another node, /robot, subscribes to /cmd_vel and publishes /odom, too: both robots obey"
        )
        assert kept


def test_several_publishers_of_a_topic_are_named_and_a_robot_with_its_guard_is_one(domain: int, tmp_path: Path) -> None:
    with contextlib.ExitStack() as others, Node("robot", NetworkConfig(domain)) as node:
        for name in ("bridge", "bridge_guard"):
            others.callback(Fork(stand, domain, name, (), ("/cmd_vel",), output=tmp_path / name).kill)
        until(lambda: [one.node for one in node.graph.endpoints()].count("/bridge_guard") == 1, "the guard is found")
        until(lambda: "/bridge" in {one.node for one in node.graph.endpoints()}, "the bridge is found")
        assert node.graph.rivals({"/cmd_vel"}) == []
        others.callback(Fork(stand, domain, "brain", (), ("/cmd_vel",), output=tmp_path / "brain").kill)
        until(lambda: "/brain" in {one.node for one in node.graph.endpoints()}, "the brain is found")
        assert node.graph.rivals({"/cmd_vel"}) == [
            "/cmd_vel has 2 publishers, brain and bridge: the newest message counts."
        ]


CONTROLLER = "control_msgs/msg/JointTrajectoryControllerState"


def has_the_fields_of_humble(domain: int) -> int:
    """Return 0 if a node of Humble publishes a type as Humble defines it; in a process of its own."""
    with Node("robot", NetworkConfig(domain, distro="humble")) as node:
        node.publisher("/state", CONTROLLER)
    return int("desired" not in dict(type_store().fielddefs[CONTROLLER][1]))


def test_types_are_those_of_the_distribution_of_the_network(domain: int, tmp_path: Path) -> None:
    assert Fork(has_the_fields_of_humble, domain, output=tmp_path / "log").wait() == 0
