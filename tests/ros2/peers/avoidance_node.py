"""The articles' avoidance node: a lidar in, a velocity out.

The nearest valid reading of the front sector, ±30° around straight ahead, decides: beyond the safe distance of 0.5 m
the robot drives at 0.2 m/s, below it turns left at 0.5 rad/s, and without a valid reading it stops.

It publishes at each scan, and a zero at its end.
"""

import math

import node as peer
import numpy as np
from geometry_msgs.msg import Twist
from rclpy.duration import Duration
from rclpy.node import Node
from sensor_msgs.msg import LaserScan

parser = peer.options(__doc__)
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
        self.publisher = node.create_publisher(Twist, "/cmd_vel", 10)
        node.create_subscription(LaserScan, "/scan", self.on_scan, 10)  # reliable, as in every tutorial
        node.create_timer(0.1, self.report)
        self.distance = math.nan
        self.scans = self.turning = self.blind = 0

    def on_scan(self, scan: LaserScan) -> None:
        self.scans += 1
        self.distance = front_range(scan)
        self.blind += math.isnan(self.distance)
        self.publish()

    def publish(self, *, zero: bool = False) -> None:
        forward, left = (0.0, 0.0) if zero else command(self.distance)
        self.turning += left > 0
        message = Twist()
        message.linear.x, message.angular.z = forward, left
        self.publisher.publish(message)

    def report(self) -> None:
        peer.log("report", scans=self.scans, turning=self.turning, without_reading=self.blind)

    def close(self) -> None:
        self.publish(zero=True)
        self.publisher.wait_for_all_acked(Duration(seconds=1))
        self.report()


if __name__ == "__main__":
    peer.run(lambda node: Avoidance(node("avoidance_node")).close, args.seconds)
