"""Bags as a real TurtleBot3 leaves them, written with `rosbags` and nothing of ours, and what we read of them."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from bhd_lerobot.ros2.bag.storage.find import find_bags

STORE = get_typestore(Stores.ROS2_HUMBLE)
START = 1_700_000_000 * 10**9
NANO = 10**9
SECONDS = 6.0
PERIODS = {"/scan": 0.2, "/odom": 0.05, "/cmd_vel": 0.1}

T = STORE.types
Time, Header = T["builtin_interfaces/msg/Time"], T["std_msgs/msg/Header"]
Vector, Quaternion = T["geometry_msgs/msg/Vector3"], T["geometry_msgs/msg/Quaternion"]

type Message = tuple[str, int, Any]  # topic, time of reception [ns], message


def header(stamp: int, frame: str) -> Any:
    return Header(stamp=Time(sec=stamp // NANO, nanosec=stamp % NANO), frame_id=frame)


def distance(angle: np.ndarray, time_s: float) -> np.ndarray:
    """Return what the robot sees: smooth in the angle, another thing each time."""
    return 1.5 + 0.5 * np.cos(angle) + 0.3 * np.sin(3 * angle + time_s)


def speed(time_s: float) -> tuple[float, float]:
    return 0.1 + 0.05 * np.sin(time_s), 0.5 * np.cos(time_s)


def command(time_s: float) -> tuple[float, float]:
    return 0.12 + 0.05 * np.sin(time_s), 0.6 * np.cos(time_s)


def scan(stamp: int, *, beams: int = 360, angle_min: float = 0.0, clockwise: bool = False, frame: str = "base_scan"):
    step = (-1 if clockwise else 1) * 2 * np.pi / beams
    angle = angle_min + step * np.arange(beams)
    ranges = distance(angle, (stamp - START) / NANO).astype(np.float32)
    return T["sensor_msgs/msg/LaserScan"](
        header=header(stamp, frame), angle_min=angle_min, angle_max=float(angle[-1]), angle_increment=step,
        time_increment=0.0, scan_time=0.2, range_min=0.12, range_max=3.5, ranges=ranges,
        intensities=np.zeros(0, np.float32),
    )  # fmt: skip


def odometry(stamp: int, *, child: str = "base_footprint"):
    time_s = (stamp - START) / NANO
    forward, turn = speed(time_s)
    yaw = 2.0 + 0.5 * np.sin(time_s)
    pose = T["geometry_msgs/msg/Pose"](
        position=T["geometry_msgs/msg/Point"](x=3.0 + 0.1 * time_s, y=-1.0, z=0.0),
        orientation=Quaternion(x=0.0, y=0.0, z=float(np.sin(yaw / 2)), w=float(np.cos(yaw / 2))),
    )
    return T["nav_msgs/msg/Odometry"](
        header=header(stamp, "odom"), child_frame_id=child,
        pose=T["geometry_msgs/msg/PoseWithCovariance"](pose=pose, covariance=np.zeros(36)),
        twist=T["geometry_msgs/msg/TwistWithCovariance"](twist=twist(forward, turn), covariance=np.zeros(36)),
    )  # fmt: skip


def twist(forward: float, turn: float):
    return T["geometry_msgs/msg/Twist"](
        linear=Vector(x=float(forward), y=0.0, z=0.0), angular=Vector(x=0.0, y=0.0, z=float(turn))
    )


def drive(
    *, seed: int = 0, seconds: float = SECONDS, stamped: bool = False, start: int = START, **of_scans: Any
) -> list[Message]:
    """Return the messages of a drive in the order of reception: jittered, delayed by milliseconds."""
    rng = np.random.default_rng(seed)
    messages: list[Message] = []
    for topic, period in PERIODS.items():
        for number in range(int(seconds / period)):
            stamp = start + int((number * period + rng.uniform(0, 0.2 * period)) * NANO)
            received = stamp + int(rng.uniform(0.001, 0.01) * NANO)
            if topic == "/scan":
                message = scan(stamp, **of_scans)
            elif topic == "/odom":
                message = odometry(stamp)
            else:
                message = twist(*command((stamp - START) / NANO))
                if stamped:
                    message = T["geometry_msgs/msg/TwistStamped"](header=header(stamp, ""), twist=message)
            messages.append((topic, received, message))
    return sorted(messages, key=lambda message: message[1])


def changed(messages: list[Message], topic: str, make: Callable[[int], Any], since: int = 0) -> list[Message]:
    """Return messages of which those of a topic are made anew, by their time, from some time on."""
    return [(name, at, make(at) if name == topic and at >= since else message) for name, at, message in messages]


def without(topic: str) -> Callable[[Message], bool]:
    return lambda message: message[0] != topic


def write(path: Path, messages: list[Message], storage: str = "mcap", compression: str = "") -> Path:
    """Write a bag, messages in the order given; compressed by file, message or storage."""
    writer = Writer(path, version=9 if compression else 8, storage_plugin=StoragePlugin[storage.upper()])
    if compression:
        writer.set_compression(CompressionMode[compression], CompressionFormat.ZSTD)
    with writer:
        connections: dict[str, Any] = {}
        for topic, received, message in messages:
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=STORE)
            writer.write(connections[topic], received, STORE.serialize_cdr(message, kind))
    return path


TOPICS = tuple(sorted(PERIODS))


def check(path: Path, messages: list[Message], *problems: str, whole: bool = True) -> int:
    """Compare what is read with what was written, or with its beginning; return how many messages were read."""
    (bag,) = find_bags(path)
    topics, read, total = bag.topics, bag.read(TOPICS), 0
    assert set(topics) <= set(TOPICS)
    for topic in TOPICS:
        wanted = [(at, bytes(STORE.serialize_cdr(one, one.__msgtype__))) for name, at, one in messages if name == topic]
        found = read[topic]
        count = len(found.data)
        total += count
        assert list(zip(found.received.tolist(), found.data, strict=True)) == wanted[:count]
        assert (np.diff(found.order) > 0).all()
        assert topics[topic].count == count if topic in topics else not count
        assert count == len(wanted) or not whole
        assert [payload for *_, payload in bag.messages((topic,))] == [payload for _, payload in wanted[:count]]
    assert len(bag.problems) == len(problems), bag.problems
    assert all(part in problem for part, problem in zip(problems, bag.problems, strict=True)), bag.problems
    return total
