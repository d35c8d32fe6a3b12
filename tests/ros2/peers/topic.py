"""What the ros2 command does, by the real client library: publish, echo and list topics.

    topic.py pub /cmd_vel geometry_msgs/msg/Twist '{"linear": {"x": 0.1}}' --hz 10 --count 5
    topic.py echo /scan sensor_msgs/msg/LaserScan --best-effort
    topic.py list

A stamp that is not given is the present. Messages are printed as JSON.
"""

import importlib
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import node as peer
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import QoSProfile, QoSReliabilityPolicy


def from_json(text: str) -> Any:
    return json.loads(Path(text[1:]).read_text() if text.startswith("@") else text)


parser = peer.options(__doc__)
parser.add_argument("verb", choices=("pub", "echo", "list"))
parser.add_argument("name", nargs="?")
parser.add_argument("type", nargs="?")
parser.add_argument("values", nargs="?", type=from_json, default={}, help="JSON, or @ and the name of a file with it")
parser.add_argument("--hz", type=float, default=10.0)
parser.add_argument("--burst", type=int, default=1, help="messages each time")
parser.add_argument("--best-effort", action="store_true")
args = parser.parse_args()
reliability = QoSReliabilityPolicy.BEST_EFFORT if args.best_effort else QoSReliabilityPolicy.RELIABLE
qos = QoSProfile(depth=10, reliability=reliability)


def load(name: str) -> Any:
    package, kind, message = name.split("/")
    return getattr(importlib.import_module(f"{package}.{kind}"), message)


def fill(message: Any, values: dict[str, Any]) -> Any:
    """Set the fields of a message from JSON; of arrays of messages, each element."""
    types = message.get_fields_and_field_types()
    for name, value in values.items():
        field = getattr(message, name)
        if isinstance(value, dict):
            fill(field, value)
        elif isinstance(value, list) and value and isinstance(value[0], dict):
            kind = load(types[name].removeprefix("sequence<").split(">")[0].split("[")[0].replace("/", "/msg/"))
            setattr(message, name, [fill(kind(), one) for one in value])
        elif isinstance(value, list) and ("double" in types[name] or "float" in types[name]):
            setattr(message, name, [float(one) for one in value])
        else:
            setattr(message, name, type(field)(value))
    return message


def plain(value: Any) -> Any:
    """Return a message or value as JSON has it; numbers that are not finite as strings."""
    if hasattr(value, "get_fields_and_field_types"):
        return {name: plain(getattr(value, name)) for name in value.get_fields_and_field_types()}
    if isinstance(value, float):
        return value if math.isfinite(value) else str(value)
    if isinstance(value, str | int | bool):
        return value
    return [plain(one.item() if hasattr(one, "item") else one) for one in value]


def publish(node: Node) -> Callable[[], None]:
    kind = load(args.type)
    publisher = node.create_publisher(kind, args.name, qos)
    sent = 0

    def send() -> None:
        nonlocal sent
        if publisher.get_subscription_count() == 0:
            return
        message = fill(kind(), args.values)
        if hasattr(message, "header") and "stamp" not in args.values.get("header", {}):
            message.header.stamp = node.get_clock().now().to_msg()
        for _ in range(args.burst):
            publisher.publish(message)
            sent += 1

    node.create_timer(1 / args.hz, send)

    def close() -> None:
        if not args.best_effort:
            publisher.wait_for_all_acked(Duration(seconds=2))
        peer.log("sent", count=sent)

    return close


def echo(node: Node) -> Callable[[], None]:
    node.create_subscription(load(args.type), args.name, lambda one: peer.log("message", message=plain(one)), qos)
    return lambda: None


def list_all(node: Node) -> Callable[[], None]:
    def show() -> None:
        nodes = sorted(f"{space.rstrip('/')}/{name}" for name, space in node.get_node_names_and_namespaces())
        peer.log("list", nodes=nodes, topics=dict(node.get_topic_names_and_types()))

    node.create_timer(0.2, show)
    return lambda: None


if __name__ == "__main__":
    verb = {"pub": publish, "echo": echo, "list": list_all}[args.verb]
    peer.run(lambda new_node: verb(new_node(f"topic_{args.verb}")), args.seconds)
