"""The messages of an arm: JointState and PoseStamped."""

from typing import override

from bhd_lerobot.ros2.messages.parts import Array, FieldsPart, Frames, Part, header
from bhd_lerobot.ros2.messages.serialize import encode

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


class PosePart(FieldsPart):
    """The pose of the tool in the base frame. Our quaternions are w, x, y, z; ROS's fields have names."""

    msgtype = "geometry_msgs/msg/PoseStamped"
    fields = (*(f"pose.position.{axis}" for axis in "xyz"), *(f"pose.orientation.{axis}" for axis in "wxyz"))
    frame = ARM_FRAME
