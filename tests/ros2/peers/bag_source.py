"""A robot whose topics are of each kind that a recorder meets; each message states its number.

    bag_source.py [--count 200] [--hz 200] [--heard FILE]

Latched topics are sent once, before anybody listens; the others as number -1 until the file is there, then COUNT times.
"""

from pathlib import Path

import node as peer
from geometry_msgs.msg import TwistStamped
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import String
from test_msgs.msg import Nested

parser = peer.options(__doc__)
parser.add_argument("--count", type=int, default=200)
parser.add_argument("--hz", type=float, default=200.0)
parser.add_argument("--heard", type=Path, required=True)
args = parser.parse_args()
BEST_EFFORT = QoSProfile(depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT)
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class Source:
    def __init__(self, node: Node) -> None:
        self.sent = -1
        self.latched = [node.create_publisher(String, name, LATCHED) for name in ("/latched", "/mixed")]
        for one in self.latched:
            one.publish(String(data="latched"))
        self.words = [
            node.create_publisher(String, "/words", 1000),
            node.create_publisher(String, "/robot1/arm/words", 1000),
            node.create_publisher(String, "/mixed", BEST_EFFORT),
            node.create_publisher(String, "/fast", BEST_EFFORT),
        ]
        self.stamped = node.create_publisher(TwistStamped, "/robot1/stamped", 1000)
        self.nested = node.create_publisher(Nested, "/nested", 1000)
        node.create_timer(1 / args.hz, self.send)

    def send(self) -> None:
        if self.sent == args.count:
            return
        if self.sent < 0 and args.heard.exists():
            self.sent = 0
        for one in self.words:
            one.publish(String(data=str(self.sent)))
        stamped, nested = TwistStamped(), Nested()
        stamped.header.stamp.sec = self.sent % 3 * 1000 if self.sent % 2 else 0  # not set, and a clock that jumps
        stamped.twist.linear.x = float(self.sent)
        nested.basic_types_value.int32_value = self.sent
        self.stamped.publish(stamped)
        self.nested.publish(nested)
        self.sent += self.sent >= 0
        if self.sent == args.count:
            peer.log("sent", count=self.sent)

    def close(self) -> None:
        peer.log("closed")


if __name__ == "__main__":
    peer.run(lambda new_node: Source(new_node("bag_source")).close, args.seconds)
