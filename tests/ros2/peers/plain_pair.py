"""A plain publisher or subscriber as every ROS tutorial has it, which measures: what ours is compared with.

    plain_pair.py publish|subscribe [--set turtlebot3|ur5|command] [--topic NAME:HZ]…

The publisher stamps each message with the time of sending. The subscriber measures the latency from there, and the time
between two messages against the rate that is named; it prints a summary and ends after --warm-up and --measure. Both
print their processor time per second of that. Either half can be used alone with another program at the other end, on
the same machine. The publisher begins when it has a subscriber.
"""

import functools
import signal
import time
from collections.abc import Callable
from typing import Any

import node as peer
import numpy as np
from geometry_msgs.msg import Twist, TwistStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import BatteryState, Imu, JointState, LaserScan

TYPES = {
    "scan": LaserScan,
    "odom": Odometry,
    "imu": Imu,
    "joint_states": JointState,
    "battery_state": BatteryState,
    "cmd_vel": TwistStamped,
}
SETS = {
    "turtlebot3": {"scan": 5, "odom": 20, "imu": 20, "joint_states": 20, "battery_state": 20},
    "ur5": {"joint_states": 500},
    "command": {"cmd_vel": 50},
}


def topic_at_rate(text: str) -> tuple[str, float]:
    name, _, hz = text.partition(":")
    if name not in TYPES:
        raise peer.argparse.ArgumentTypeError(f"{name!r} is none of {', '.join(TYPES)}")
    return name, float(hz)


parser = peer.options(__doc__)
parser.add_argument("half", choices=("publish", "subscribe"))
parser.add_argument("--set", choices=tuple(SETS), action="append", default=[])
parser.add_argument("--topic", type=topic_at_rate, action="append", default=[], metavar="NAME:HZ")
parser.add_argument("--twist", action="store_true", help="cmd_vel is Twist, which has no stamp: no latency")
parser.add_argument("--warm-up", type=float, default=2.0, help="time from the first message that is not measured [s]")
parser.add_argument("--measure", type=float, default=10.0, help="[s]")
args = parser.parse_args()
if args.twist:
    TYPES["cmd_vel"] = Twist
RATES = {name: float(hz) for one in args.set for name, hz in SETS[one].items()} | dict(args.topic)
if not RATES:
    parser.error("name a --set or a --topic")


def example(name: str) -> Any:
    """Return a message of the size that the robot's has."""
    message = TYPES[name]()
    if name == "scan":
        message.angle_max, message.angle_increment = 2 * np.pi, np.pi / 180
        message.range_min, message.range_max = 0.12, 3.5
        message.ranges, message.intensities = [1.5] * 360, [200.0] * 360
    elif name == "joint_states":
        joints = 6 if RATES[name] > 100 else 2
        message.name = [f"joint_{index}" for index in range(joints)]
        message.position = message.velocity = message.effort = [0.5] * joints
    return message


class Window:
    """The time that is measured: it begins --warm-up after the first message."""

    def __init__(self) -> None:
        self.first: float | None = None
        self.begin: float | None = None
        self.is_over = False
        self.processor = 0.0

    def touch(self) -> bool:
        """Tell whether now is in the window, and print the share of a processor after it."""
        now = time.monotonic()
        if self.first is None:
            self.first = now
        if self.begin is None and now - self.first >= args.warm_up:
            self.begin, self.processor = now, time.process_time()
        if self.begin is not None and not self.is_over and now - self.begin >= args.measure:
            self.is_over = True
            peer.log("processor", half=args.half, share=(time.process_time() - self.processor) / (now - self.begin))
        return self.begin is not None and not self.is_over


class Publisher:
    def __init__(self, node: Node) -> None:
        self.node = node
        self.window = Window()
        self.sent = dict.fromkeys(RATES, 0)
        self.since, self.sent_since = 0, 0  # stamp of the first message with one after the warm-up; how many from it on
        for name, hz in RATES.items():
            qos = qos_profile_sensor_data if name == "scan" else 10
            publisher = node.create_publisher(TYPES[name], f"/{name}", qos)
            node.create_timer(1 / hz, functools.partial(self.send, name, publisher, example(name)))

    def send(self, name: str, publisher: Any, message: Any) -> None:
        if self.node.count_subscribers(f"/{name}") == 0 and self.window.first is None:
            return
        self.window.touch()
        if hasattr(message, "header"):
            now = time.time_ns()
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(now, 10**9)
            if self.window.begin is not None:
                self.since = self.since or now
                self.sent_since += 1
        publisher.publish(message)
        self.sent[name] += 1

    def close(self) -> None:
        peer.log("summary", half="publish", sent=self.sent, since=self.since, sent_since=self.sent_since)


class Subscriber:
    def __init__(self, node: Node) -> None:
        self.window = Window()
        self.arrivals: dict[str, list[float]] = {name: [] for name in RATES}
        self.latencies: dict[str, list[float]] = {name: [] for name in RATES}
        for name in RATES:
            node.create_subscription(
                TYPES[name],
                f"/{name}",
                lambda message, name=name: self.receive(name, message),
                qos_profile_sensor_data if name == "scan" else 10,
            )

    def receive(self, name: str, message: Any) -> None:
        now = time.time_ns()
        if not self.window.touch():
            if self.window.is_over:
                signal.raise_signal(signal.SIGTERM)
            return
        self.arrivals[name].append(time.monotonic())
        if hasattr(message, "header"):
            stamp = message.header.stamp
            self.latencies[name].append((now - stamp.sec * 10**9 - stamp.nanosec) * 1e-9)

    def summarise(self) -> None:
        topics = {}
        for name, hz in RATES.items():
            errors = np.abs(np.diff(self.arrivals[name]) - 1 / hz)
            topics[name] = {
                "messages": len(self.arrivals[name]),
                "hz": (len(self.arrivals[name]) - 1) / np.ptp(self.arrivals[name]) if len(errors) else 0.0,
                "latency_p50": percentile(self.latencies[name], 50),
                "latency_p99": percentile(self.latencies[name], 99),
                "interval_error_p50": percentile(errors, 50),
                "interval_error_p99": percentile(errors, 99),
            }
        peer.log("summary", half="subscribe", topics=topics)


def percentile(values: Any, percent: float) -> float | None:
    """Return a percentile, None of nothing."""
    return float(np.percentile(values, percent)) if len(values) else None


def main(new_node: Callable[[str], Node]) -> Callable[[], None]:
    if args.half == "publish":
        return Publisher(new_node("plain_publisher")).close
    return Subscriber(new_node("plain_subscriber")).summarise


if __name__ == "__main__":
    peer.run(main, args.seconds)
