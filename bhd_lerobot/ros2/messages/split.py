"""Which topics carry the numbers of a feature: the names decide."""

import re
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from bhd_lerobot.bodies.body import LidarSpec
from bhd_lerobot.bodies.registry import body_of
from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.errors import UnsupportedDatasetError
from bhd_lerobot.ros2.messages.base import BaseNoise, OdometryPart, ScanPart
from bhd_lerobot.ros2.messages.parts import FieldsPart, NumbersPart, Part, own_topic
from bhd_lerobot.ros2.messages.table import (
    ARM_FRAME,
    FOOTPRINT_FRAME,
    GYRO,
    IMU_FRAME,
    IMU_TYPE,
    JOINTS,
    ODOMETRY,
    POSE_TYPE,
    STAMPED_TWIST,
    TOOL,
    TWIST,
    TWIST_TYPE,
)

_SCAN = re.compile(r"scan_\d+\.pos")
_OBSERVED, _ASKED, _APPLIED = keys.OBSERVATION_STATE, keys.ACTION, keys.APPLIED_ACTION
_SUFFIX = {_ASKED: "", _APPLIED: "_applied"}
_POSE = {"msgtype": POSE_TYPE, "name": "PosePart", "frame": ARM_FRAME}
_JOINTS = {"msgtype": JOINTS, "name": "JointsPart", "frame": ""}
_STAMPED_TWIST = {"msgtype": STAMPED_TWIST, "name": "TwistPart", "frame": FOOTPRINT_FRAME}
_BARE_TWIST = {"msgtype": TWIST_TYPE, "name": "BareTwistPart"}


def parts_of(
    key: str,
    names: Sequence[str],
    robot_type: str,
    *,
    lidar: LidarSpec | None,
    noise: BaseNoise | None = None,
    bare_twist: bool = False,
) -> list[Part]:
    """Return what carries a vector of floats; every name is in exactly one part."""
    left = list(names)
    parts: list[Part] = []

    def take(kind: type[Part], topic: str, wanted: Sequence[str], **options: Any) -> None:
        if wanted and set(wanted) <= set(left):
            parts.append(kind(topic, tuple(wanted), **options))
            left[:] = [name for name in left if name not in wanted]

    if body_of(robot_type) is not None and len(set(names)) == len(names):
        if key == _OBSERVED:
            take(OdometryPart, "/odom", (*TWIST, *ODOMETRY), noise=noise)
            take(OdometryPart, "/odom", TWIST, noise=noise)
            take(FieldsPart, "/imu", GYRO, **gyro_message(noise))
            if lidar is not None:
                take(ScanPart, "/scan", [name for name in names if _SCAN.fullmatch(name)], lidar=lidar)
            take(FieldsPart, "/tool_pose", TOOL, **_POSE)
            joints = [name.removesuffix(".pos") for name in left if name.endswith(".pos")]
            speeds = [f"{joint}.vel" for joint in joints]
            with_speeds = speeds if set(speeds) <= set(left) else []
            take(FieldsPart, "/joint_states", [f"{joint}.pos" for joint in joints] + with_speeds, **_JOINTS)
        elif key in _SUFFIX:
            end = _SUFFIX[key]
            take(FieldsPart, f"/cmd_vel{end}", TWIST, **(_BARE_TWIST if bare_twist else _STAMPED_TWIST))
            take(FieldsPart, f"/tool_command{end}", TOOL, **_POSE)
            take(FieldsPart, f"/joint_command{end}", [name for name in left if name.endswith(".pos")], **_JOINTS)
    if left:
        parts.append(NumbersPart(own_topic(key), tuple(left)))
    return parts


def gyro_message(noise: BaseNoise | None = None) -> dict[str, Any]:
    """Return what `FieldsPart` needs of a gyroscope; orientation and acceleration are marked as unknown, as in ROS."""
    unknown = np.array([-1.0, *[0.0] * 8])
    rest = {"orientation": {"w": 1.0}, "orientation_covariance": unknown, "linear_acceleration_covariance": unknown}
    if noise is not None:
        rest["angular_velocity_covariance"] = np.eye(3).reshape(-1) * noise.gyro**2
    return {"msgtype": IMU_TYPE, "name": "GyroPart", "frame": IMU_FRAME, "rest": rest}


def check_topics(topics: Iterable[str]) -> None:
    """Check that no two features share a topic, nor one with what every bag has."""
    seen: set[str] = set()
    for topic in topics:
        if topic in seen:
            raise UnsupportedDatasetError(
                f"A feature would share the topic {topic}: with another one, because their names differ only in "
                "characters that no topic may have, or with what every exported bag has there. Rename it."
            )
        seen.add(topic)
