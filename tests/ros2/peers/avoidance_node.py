"""The articles' avoidance node: a lidar in, a velocity out.

The nearest valid reading of the front sector, ±30° around straight ahead, decides: beyond the safe distance of 0.5 m
the robot drives at 0.2 m/s, below it turns left at 0.5 rad/s, and without a valid reading it stops.

It publishes at each scan, with --hz at a rate of its own, and a zero at its end.
"""

import math
import time

import node as peer
import numpy as np
from geometry_msgs.msg import Twist, TwistStamped
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import LaserScan

parser = peer.options(__doc__)
parser.add_argument("--command-topic", default="/cmd_vel")
parser.add_argument("--twist", action="store_true", help="publish Twist, as up to Humble, instead of TwistStamped")
parser.add_argument("--hz", type=float, help="publish at this rate, not at each scan [Hz]")
parser.add_argument("--report", type=float, default=1.0, help="time between two lines of the log [s]")
args = parser.parse_args()

FRONT = math.radians(30)
SAFE_DISTANCE = 0.5  # [m]
FORWARD = 0.2  # [m/s]
LEFT = 0.5  # [rad/s]


def front_range(scan: LaserScan) -> float:
    """Return the nearest valid reading of the front sector [m], NaN where there is none."""
    ranges = np.asarray(scan.ranges, dtype=float)
    angles = scan.angle_min + scan.angle_increment * np.arange(len(ranges))
    angles = np.arctan2(np.sin(angles), np.cos(angles))
    with np.errstate(invalid="ignore"):
        valid = (np.abs(angles) <= FRONT) & (ranges >= scan.range_min) & (ranges <= scan.range_max)
    return float(ranges[valid].min()) if valid.any() else math.nan


def command(distance: float) -> tuple[float, float]:
    """Return the forward [m/s] and the turning speed [rad/s] at a distance [m]."""
    if math.isnan(distance):
        return 0.0, 0.0
    return (FORWARD, 0.0) if distance > SAFE_DISTANCE else (0.0, LEFT)


class Avoidance:
    def __init__(self, node: Node) -> None:
        self.node = node
        self.publisher = node.create_publisher(Twist if args.twist else TwistStamped, args.command_topic, 10)
        node.create_subscription(LaserScan, "/scan", self.on_scan, qos_profile_sensor_data)
        if args.hz:
            node.create_timer(1 / args.hz, self.publish)
        node.create_timer(args.report, self.report)
        self.distance = math.nan
        self.scans = self.commands = self.scans_before = self.commands_before = self.turning = self.blind = 0
        self.nearest = math.inf
        self.since = time.monotonic()

    def on_scan(self, scan: LaserScan) -> None:
        self.scans += 1
        self.distance = front_range(scan)
        self.nearest = min(self.nearest, self.distance if self.distance == self.distance else math.inf)
        self.blind += math.isnan(self.distance)
        if not args.hz:
            self.publish()

    def publish(self, *, zero: bool = False) -> None:
        forward, left = (0.0, 0.0) if zero else command(self.distance)
        self.commands += 1
        self.turning += left > 0
        message = Twist() if args.twist else TwistStamped()
        if not args.twist:
            message.header.stamp = self.node.get_clock().now().to_msg()
            message.header.frame_id = "base_link"
        twist = message if args.twist else message.twist
        twist.linear.x, twist.angular.z = forward, left
        self.publisher.publish(message)

    def report(self) -> None:
        now = time.monotonic()
        elapsed, self.since = now - self.since, now
        peer.log(
            "report",
            scans=self.scans,
            scan_hz=(self.scans - self.scans_before) / elapsed,
            commands=self.commands,
            command_hz=(self.commands - self.commands_before) / elapsed,
            turning=self.turning,
            without_reading=self.blind,
            front=None if math.isnan(self.distance) else self.distance,
            nearest=None if math.isinf(self.nearest) else self.nearest,
        )
        self.scans_before, self.commands_before = self.scans, self.commands

    def close(self) -> None:
        self.publish(zero=True)
        self.publisher.wait_for_all_acked(Duration(seconds=1))
        self.report()


if __name__ == "__main__":
    peer.run(lambda node: Avoidance(node("avoidance_node")).close, args.seconds)
