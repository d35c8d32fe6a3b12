"""Which topics carry the numbers of a feature: the names decide."""

import re
from collections.abc import Iterable, Sequence
from typing import Any

from bhd_lerobot.bodies.body import LidarSpec
from bhd_lerobot.bodies.registry import body_of
from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.errors import UnsupportedDatasetError
from bhd_lerobot.ros2.messages.arm import TOOL, JointsPart, PosePart
from bhd_lerobot.ros2.messages.base import (
    GYRO,
    ODOMETRY,
    TWIST,
    BareTwistPart,
    BaseNoise,
    GyroPart,
    OdometryPart,
    ScanPart,
    TwistPart,
)
from bhd_lerobot.ros2.messages.parts import NumbersPart, Part, own_topic

_SCAN = re.compile(r"scan_\d+\.pos")
_OBSERVED, _ASKED, _APPLIED = keys.OBSERVATION_STATE, keys.ACTION, keys.APPLIED_ACTION
_SUFFIX = {_ASKED: "", _APPLIED: "_applied"}


def parts_of(
    key: str,
    names: Sequence[str],
    robot_type: str,
    *,
    lidar: LidarSpec | None,
    noise: BaseNoise | None = None,
    bare_twist: bool = False,
) -> list[Part]:
    """Return what carries a vector of floats; every name is in exactly one part.

    Args:
        noise: of what it measures of its own motion, if it is known; only needed to write.
    """
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
            take(GyroPart, "/imu", GYRO, noise=noise)
            if lidar is not None:
                take(ScanPart, "/scan", [name for name in names if _SCAN.fullmatch(name)], lidar=lidar)
            take(PosePart, "/tool_pose", TOOL)
            joints = [name.removesuffix(".pos") for name in left if name.endswith(".pos")]
            speeds = [f"{joint}.vel" for joint in joints]
            with_speeds = speeds if set(speeds) <= set(left) else []
            take(JointsPart, "/joint_states", [f"{joint}.pos" for joint in joints] + with_speeds)
        elif key in _SUFFIX:
            end = _SUFFIX[key]
            take(BareTwistPart if bare_twist else TwistPart, f"/cmd_vel{end}", TWIST)
            take(PosePart, f"/tool_command{end}", TOOL)
            take(JointsPart, f"/joint_command{end}", [name for name in left if name.endswith(".pos")])
    if left:
        parts.append(NumbersPart(own_topic(key), tuple(left)))
    return parts


def check_topics(parts: Iterable[Part]) -> None:
    """Check that no two parts share a topic."""
    seen: set[str] = set()
    for part in parts:
        if part.topic in seen:
            raise UnsupportedDatasetError(
                f"Two features would share the topic {part.topic}, because their names differ only in characters that "
                "no topic may have. Rename one."
            )
        seen.add(part.topic)
