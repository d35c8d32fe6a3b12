"""The messages of a base with a scanner that are more than fields: Odometry and LaserScan."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, override

import numpy as np

from bhd_lerobot.bodies.body import LidarSpec
from bhd_lerobot.ros2.messages.parts import NANO, Array, Frames, Part, header
from bhd_lerobot.ros2.messages.serialize import encode
from bhd_lerobot.ros2.messages.table import FOOTPRINT_FRAME, ODOM_FRAME, ODOMETRY_TYPE, SCAN, SCAN_FRAME, TWIST


@dataclass(frozen=True)
class BaseNoise:
    """Standard deviations of what a base measures of its own motion.

    Attributes:
        distance: of the way it has gone, along its heading [m].
        yaw: of its heading since the start [rad].
        speed: of its forward speed [m/s].
        turn: of its yaw rate [rad/s].
        gyro: of each axis of its gyroscope [rad/s].
    """

    distance: float
    yaw: float
    speed: float
    turn: float
    gyro: float


def twists(messages: Sequence[Any]) -> Array:
    """Return the forward speeds and yaw rates in `geometry_msgs/msg/Twist`, shape (n, 2)."""
    return np.array([(message.linear.x, message.angular.z) for message in messages], np.float64).reshape(-1, 2)


def twist_tree(values: Array) -> dict[str, Any]:
    """Return `geometry_msgs/msg/Twist` of forward speeds and yaw rates, shape (n, 2)."""
    return {"linear": {"x": values[:, 0]}, "angular": {"z": values[:, 1]}}


@dataclass(frozen=True)
class OdometryPart(Part):
    """What the wheels measure: speeds, and the pose where it is recorded.

    Where it is not, the message's pose is integrated from the speeds, so that a viewer has a path to draw; how far it
    is off is not known then.
    """

    msgtype: str = ODOMETRY_TYPE
    noise: BaseNoise | None = None

    @override
    def encode(self, frames: Frames, values: Array) -> list[bytes]:
        pose = self.pose(frames, values)
        fields: dict[str, Any] = {
            "header": header(frames.stamps, ODOM_FRAME),
            "child_frame_id": FOOTPRINT_FRAME,
            "pose": {"pose": {"position": {"x": pose[:, 0], "y": pose[:, 1]}, "orientation": _yaw_tree(pose[:, 2])}},
            "twist": {"twist": twist_tree(values)},
        }
        if self.noise is not None:
            fields["twist"]["covariance"] = np.diag([self.noise.speed**2, *[0] * 4, self.noise.turn**2]).reshape(-1)
            if len(self.names) > len(TWIST):
                fields["pose"]["covariance"] = _pose_covariance(self.noise, pose[:, 2])
        return encode(self.msgtype, fields, len(values))

    def pose(self, frames: Frames, values: Array) -> Array:
        """Return x, y and yaw at each frame, shape (n, 3)."""
        if len(self.names) > len(TWIST):
            return values[:, 2:5]
        step = np.diff(frames.stamps, prepend=frames.stamps[:1]) / NANO
        speed, turn = values[:, 0], values[:, 1]
        yaw = np.cumsum(step * (turn + np.roll(turn, 1)) / 2)
        way, middle = step * (speed + np.roll(speed, 1)) / 2, (yaw + np.roll(yaw, 1)) / 2
        return np.stack([np.cumsum(way * np.cos(middle)), np.cumsum(way * np.sin(middle)), yaw], axis=1)


def _pose_covariance(noise: BaseNoise, yaw: Array) -> Array:
    """Return the covariances of x, y, z, roll, pitch and yaw, row by row, shape (n, 36)."""
    ahead = np.stack([np.cos(yaw), np.sin(yaw)], axis=1)
    covariance = np.zeros((len(yaw), 6, 6))
    covariance[:, :2, :2] = noise.distance**2 * (ahead[:, :, None] * ahead[:, None, :])
    covariance[:, 5, 5] = noise.yaw**2
    return covariance.reshape(len(yaw), 36)


def odometry(messages: Sequence[Any]) -> tuple[Array, Array]:
    """Return forward speeds and yaw rates, shape (n, 2), and x, y and unwrapped yaw, shape (n, 3).

    The yaw of a quaternion that was never set, all zeros, is not a number.
    """
    poses = [message.pose.pose for message in messages]
    yaw = np.array([yaw_of(one.w, one.x, one.y, one.z) for one in (pose.orientation for pose in poses)])
    place = np.array([(pose.position.x, pose.position.y) for pose in poses], np.float64).reshape(-1, 2)
    return twists([message.twist.twist for message in messages]), np.stack([*place.T, unwrapped(yaw)], axis=1)


def yaw_of(w: float, x: float, y: float, z: float) -> float:
    """Return the yaw of a unit quaternion [rad]; that of one that was never set, all zeros, is not a number."""
    if x == y == 0:  # half the angle is precise also where a yaw of zero, or one with its sign, has to come back
        return 2 * math.atan2(z, w) if w or z else math.nan
    return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def unwrapped(yaw: Array, turn: float = 2 * np.pi) -> Array:
    """Return angles without jumps by whole turns, shape (n,); those that are not finite stay.

    Args:
        turn: a whole one, in the angles' unit.
    """
    finite = np.isfinite(yaw)
    result = yaw.copy()
    # An angle is changed by whole turns only: what needs none stays as it is, to the last bit.
    turns = np.round((np.unwrap(yaw[finite], period=turn) - yaw[finite]) / turn)
    result[finite] = np.where(turns == 0, yaw[finite], yaw[finite] + turns * turn)
    return result


def _yaw_tree(yaw: Array) -> dict[str, Array]:
    return {"z": np.sin(yaw / 2), "w": np.cos(yaw / 2)}


@dataclass(frozen=True)
class ScanPart(Part):
    """A scan. Without a return, ROS has infinity and the dataset the maximum range."""

    msgtype: str = SCAN
    lidar: LidarSpec | None = None

    @override
    def encode(self, frames: Frames, values: Array) -> list[bytes]:
        assert self.lidar is not None
        beams = len(self.names)
        low, high = np.float32(self.lidar.range_min), np.float32(self.lidar.range_max)
        ranges = values.astype(np.float32)
        ranges[ranges == high] = np.inf
        fields = {
            "header": header(frames.stamps, SCAN_FRAME),
            "angle_max": 2 * np.pi * (beams - 1) / beams,
            "angle_increment": 2 * np.pi / beams,
            "scan_time": 1 / self.lidar.rate_hz,
            "range_min": low,
            "range_max": high,
            "ranges": ranges,
        }
        return encode(self.msgtype, fields, len(values))
