"""Tool poses as the numbers of an action."""

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.control.commands import Pose

TOOL_NAMES = (
    "tool_x.pos",
    "tool_y.pos",
    "tool_z.pos",
    "tool_qw.pos",
    "tool_qx.pos",
    "tool_qy.pos",
    "tool_qz.pos",
    "gripper.pos",
)
"""Position [m] and orientation (unit quaternion) of the tool frame in the base frame, and the gripper's opening [m]."""

_SLACK = 0.2  # how far a policy's quaternion may be from unit length; it is normalised


def pose_matrices(values: NDArray[np.float64]) -> tuple[NDArray[np.float64], str | None]:
    """Return the homogeneous transform of a position and a quaternion wxyz, and what is wrong with them, if anything.

    Args:
        values: x, y, z [m], w, x, y, z, shape (7,). The quaternion is normalised, as a network's output is only nearly
            of unit length.
    """
    length = float(np.sqrt((values[3:] * values[3:]).sum()))
    if not abs(length - 1) <= _SLACK:
        return np.eye(4), f"the quaternion {values[3:].tolist()} has the length {length:g}; it must be near 1"
    x, y, z, *quaternion = values.tolist()
    return Pose((x, y, z), (quaternion[0], quaternion[1], quaternion[2], quaternion[3])).matrix(), None
