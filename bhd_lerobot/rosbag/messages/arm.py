"""The messages of an arm: JointState and PoseStamped."""

from collections.abc import Sequence
from typing import Any, override

import numpy as np

from bhd_lerobot.errors import DatasetError
from bhd_lerobot.rosbag.messages.cdr import encode
from bhd_lerobot.rosbag.messages.cdr_read import decode
from bhd_lerobot.rosbag.messages.parts import WXYZ, XYZ, Array, Frames, Part, header

TOOL = tuple(f"tool_{name}.pos" for name in ("x", "y", "z", "qw", "qx", "qy", "qz"))
ARM_FRAME, TOOL_FRAME = "base", "tool"


class JointsPart(Part):
    """Positions of joints, and their speeds where there are any."""

    msgtype = "sensor_msgs/msg/JointState"

    @property
    def joints(self) -> list[str]:
        """The joints' names, as ROS has them."""
        return [f"{name.removesuffix('.pos')}_joint" for name in self.names if name.endswith(".pos")]

    @override
    def encode(self, frames: Frames, values: Array) -> list[bytes]:
        count = len(self.joints)
        fields = {"header": header(frames.stamps), "name": self.joints, "position": values[:, :count]}
        if len(self.names) > count:
            fields["velocity"] = values[:, count:]
        return encode(self.msgtype, fields, len(values))

    @override
    def decode(self, messages: Sequence[bytes]) -> Array:
        found = decode(self.msgtype, messages, ("name", "position", "velocity"))
        if any(list(names) != self.joints for names in found["name"]):
            raise DatasetError(f"The joints of {self.topic} are not {', '.join(self.joints)}.")
        blocks = [found["position"]] + [found["velocity"]] * (len(self.names) > len(self.joints))
        if any(block.ndim != 2 or block.shape[1] != len(self.joints) for block in blocks):
            raise DatasetError(f"{self.topic} has not as many numbers as joints.")
        return np.concatenate(blocks, axis=1)


class PosePart(Part):
    """The pose of the tool in the base frame. Our quaternions are w, x, y, z; ROS's fields have names."""

    msgtype = "geometry_msgs/msg/PoseStamped"

    @override
    def encode(self, frames: Frames, values: Array) -> list[bytes]:
        fields = {"header": header(frames.stamps, ARM_FRAME), "pose": pose_tree(values)}
        return encode(self.msgtype, fields, len(values))

    @override
    def decode(self, messages: Sequence[bytes]) -> Array:
        paths = [f"pose.position.{axis}" for axis in XYZ] + [f"pose.orientation.{axis}" for axis in WXYZ]
        return np.stack(list(decode(self.msgtype, messages, paths).values()), axis=1)


def pose_tree(values: Array) -> dict[str, Any]:
    """Return `geometry_msgs/msg/Pose` of positions and quaternions wxyz, shape (n, 7)."""
    return {
        "position": dict(zip(XYZ, values[:, :3].T, strict=True)),
        "orientation": dict(zip(WXYZ, values[:, 3:].T, strict=True)),
    }
