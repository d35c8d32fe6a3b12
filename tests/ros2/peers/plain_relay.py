"""A plain relay of twists from a brain's topic to a robot's, and what measures how long one, or our bridge, takes.

    plain_relay.py relay|measure [--hz HZ]

What is measured is the time from sending a twist to receiving it at the other end, both in this process; each twist is
told by its speed, which differs from that of the one before by so little that no limit of a robot changes it. They are
sent at random times, so that they meet every moment of what lies between. It prints a summary after --warm-up and
--measure.
"""

import random
import signal
import threading
import time
from collections.abc import Callable

import node as peer
import numpy as np
from geometry_msgs.msg import TwistStamped
from rclpy.node import Node

BRAIN, ROBOT = "/brain/cmd_vel", "/cmd_vel"
SLOWEST, STEP, STEPS = 0.05, 1e-4, 500  # [m/s]

parser = peer.options(__doc__)
parser.add_argument("role", choices=("relay", "measure"))
parser.add_argument("--hz", type=float, default=20.0, help="how often a twist is sent, on average")
parser.add_argument("--warm-up", type=float, default=2.0, help="time from the first message that is not measured [s]")
parser.add_argument("--measure", type=float, default=10.0, help="[s]")
args = parser.parse_args()


class Relay:
    def __init__(self, node: Node) -> None:
        publisher = node.create_publisher(TwistStamped, ROBOT, 10)
        node.create_subscription(TwistStamped, BRAIN, publisher.publish, 10)

    def close(self) -> None:
        pass


class Measure:
    def __init__(self, node: Node) -> None:
        self.publisher = node.create_publisher(TwistStamped, BRAIN, 10)
        node.create_subscription(TwistStamped, ROBOT, self.on_twist, 10)
        self.sent: dict[int, float] = {}  # number of the speed -> when it was sent last, or nothing once it has arrived
        self.latencies: list[float] = []
        self.first: float | None = None
        threading.Thread(target=self.send, daemon=True).start()

    def send(self) -> None:
        count = missed = 0
        while self.first is None or time.monotonic() - self.first < args.warm_up + args.measure:
            time.sleep(random.uniform(0.5, 1.5) / args.hz)
            message, number = TwistStamped(), count % STEPS
            message.twist.linear.x = SLOWEST + STEP * number
            missed += number in self.sent
            self.sent[number] = time.monotonic()
            self.publisher.publish(message)
            count += 1
        time.sleep(0.5)
        values = self.latencies
        p50, p99 = (float(np.percentile(values, percent)) if values else None for percent in (50, 99))
        peer.log("summary", count=len(values), p50=p50, p99=p99, missed=missed + len(self.sent), sent=count)
        signal.raise_signal(signal.SIGTERM)

    def on_twist(self, message: TwistStamped) -> None:
        now = time.monotonic()
        sent = self.sent.pop(round((message.twist.linear.x - SLOWEST) / STEP), None)
        if sent is None:
            return  # it is repeated
        self.first = self.first or now
        if now - self.first > args.warm_up:
            self.latencies.append(now - sent)

    def close(self) -> None:
        pass


def main(new_node: Callable[[str], Node]) -> Callable[[], None]:
    kind = Relay if args.role == "relay" else Measure
    return kind(new_node(f"plain_{args.role}")).close


if __name__ == "__main__":
    peer.run(main, args.seconds)
