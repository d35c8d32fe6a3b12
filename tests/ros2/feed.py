"""A robot's node on the network, in a thread of the test: it sends what it is given, and keeps what it receives."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from bhd_lerobot.ros2.live.network import NetworkConfig, Qos
from bhd_lerobot.ros2.live.node import Node
from bhd_lerobot.ros2.messages.parts import header
from bhd_lerobot.ros2.messages.serialize import encode
from bhd_lerobot.ros2.messages.views import TF

ODOMETRY, SCAN, JOINTS = "nav_msgs/msg/Odometry", "sensor_msgs/msg/LaserScan", "sensor_msgs/msg/JointState"
TWIST, FLOATS = "geometry_msgs/msg/Twist", "std_msgs/msg/Float64MultiArray"

type Sent = tuple[str, str, dict[str, Any]]  # topic, type, fields


def head(frame: str = "", late_s: float = 0.0) -> dict[str, Any]:
    return header(np.array([time.time_ns() - round(late_s * 1e9)]), frame)


def odometry(speed: float = 0.0, yaw: float = 0.0, sign: float = 1.0) -> dict[str, Any]:
    turn = {"z": np.array([sign * np.sin(yaw / 2)]), "w": np.array([sign * np.cos(yaw / 2)])}
    twist = {"twist": {"linear": {"x": np.array([speed])}}}
    return {
        "header": head("odom"),
        "child_frame_id": "base_link",
        "pose": {"pose": {"orientation": turn}},
        "twist": twist,
    }


def scan(ranges: np.ndarray, frame: str = "base_scan", **options: float) -> dict[str, Any]:
    step = 2 * np.pi / len(ranges)
    return {
        "header": head(frame, **options), "angle_max": np.array([step * (len(ranges) - 1)]),
        "angle_increment": np.array([step]), "range_min": np.array([0.1]), "range_max": np.array([10.0]),
        "ranges": ranges.astype(np.float32)[None],
    }  # fmt: skip


def mounted(child: str, yaw: float, parent: str = "base_link") -> dict[str, Any]:
    rotation = {"z": np.array([np.sin(yaw / 2)]), "w": np.array([np.cos(yaw / 2)])}
    return {"transforms": [{"header": head(parent), "child_frame_id": child, "transform": {"rotation": rotation}}]}


@contextmanager
def feed(
    domain: int,
    make: Callable[[float], list[Sent]],
    *,
    name: str = "robot",
    hz: float = 20.0,
    receives: tuple[tuple[str, str], ...] = (("/cmd_vel", TWIST),),
    frames: tuple[tuple[str, dict[str, Any]], ...] = (),
    kept: tuple[Sent, ...] = (),
) -> Iterator[list[tuple[str, Any]]]:
    """Send what `make` returns at a time since the start [s], so many times a second; give what is received.

    Each name of a topic has a publisher of its own: ``/odom`` and ``/odom#2`` are two of one topic.

    Args:
        receives: topics that are subscribed to, with their types.
        frames: topics of transforms that are sent once, and the transforms.
        kept: further messages that are sent once, for those that come later, too.
    """
    end, received = threading.Event(), list[tuple[str, Any]]()
    with Node(name, NetworkConfig(domain)) as node:
        inputs = [node.subscription(topic, kind) for topic, kind in receives]
        outputs: dict[str, Any] = {}
        for topic, kind, tree in (*[(topic, TF, tree) for topic, tree in frames], *kept):
            outputs[topic] = node.publisher(topic, kind, Qos(1, transient_local=True))
            outputs[topic].send(encode(kind, tree, 1)[0])

        def run() -> None:
            start = time.monotonic()
            while not end.wait(1 / hz):
                for topic, kind, tree in make(time.monotonic() - start):
                    if topic not in outputs:
                        outputs[topic] = node.publisher(topic.partition("#")[0], kind)
                    outputs[topic].send(encode(kind, tree, 1)[0])
                for one in inputs:
                    received.extend((one.topic, got.message()) for got in one.take())

        thread = threading.Thread(target=run)
        thread.start()
        try:
            yield received
        finally:
            end.set()
            thread.join()
