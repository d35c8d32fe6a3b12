"""What a simulator, or a robot's own sensors, know of bases and arms: what tasks judge by."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class BaseTruth:
    """What the simulator knows about bases, at the end of a frame.

    Attributes:
        base_pose_in_world: x [m], y [m], yaw [rad], shape (n, 3).
        touched: whether the robot touched the scene at any time in the frame, shape (n,).
    """

    base_pose_in_world: NDArray[np.float64]
    touched: NDArray[np.bool_]


@dataclass(frozen=True)
class ArmTruth:
    """What the simulator knows about arms, at the end of a frame. Poses are in the base frame: x, y, z [m], wxyz.

    Attributes:
        tool_pose: of the tool frame, shape (n, 7).
        object_poses: of the objects' centres, shape (n, MAX_OBJECTS, 7); the origin for those that are not there.
        opening: opening of the gripper [m], shape (n,).
        arm_on_table: whether the arm touched the table at any time in the frame, shape (n,).
        arm_on_object: whether a link other than the gripper touched an object, shape (n,).
        self_contact: whether the arm touched itself, shape (n,).
        fingers_on_object: whether a finger touches each object at the end of the frame, shape (n, MAX_OBJECTS).
    """

    tool_pose: NDArray[np.float64]
    object_poses: NDArray[np.float64]
    opening: NDArray[np.float64]
    arm_on_table: NDArray[np.bool_]
    arm_on_object: NDArray[np.bool_]
    self_contact: NDArray[np.bool_]
    fingers_on_object: NDArray[np.bool_]


@dataclass(frozen=True)
class MobileArmTruth(BaseTruth, ArmTruth):
    """What the simulator knows about arms on bases, at the end of a frame; poses are in the base frame of each."""


def truth_of(fields: dict[str, Any]) -> BaseTruth | ArmTruth | MobileArmTruth:
    """Return what is known of robots with a drive, an arm or both, by its fields."""
    if "tool_pose" not in fields:
        return BaseTruth(**fields)
    return MobileArmTruth(**fields) if "touched" in fields else ArmTruth(**fields)
