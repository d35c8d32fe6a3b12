"""Topics that are there for those who look at a bag: transforms, cameras' geometry, wheels. Nothing reads them back."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import LidarSpec
from bhd_lerobot.data import features as keys
from bhd_lerobot.data.ros2_arm import ARM_FRAME, TOOL, TOOL_FRAME
from bhd_lerobot.data.ros2_base import FOOTPRINT_FRAME, ODOM_FRAME, OdometryPart
from bhd_lerobot.data.ros2_cdr import encode
from bhd_lerobot.data.ros2_parts import Array, Frames, header

TF = "tf2_msgs/msg/TFMessage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
JOINT_STATE = "sensor_msgs/msg/JointState"


@dataclass(frozen=True)
class StaticFrame:
    """A frame that sits still in another one.

    Attributes:
        parent, child: their names.
        position: of the child's origin in the parent [m].
        rotation: of the child in the parent, a unit quaternion wxyz.
    """

    parent: str
    child: str
    position: tuple[float, float, float]
    rotation: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class RobotView:
    """What is known of a robot beside its data.

    Attributes:
        lidar: its range finder, if it has one.
        frames: of its sensors.
        fovy: vertical field of view of its cameras by name [rad].
        tool_pose: gives position and quaternion wxyz of the tool in the base frame, shape (n, 7), of the positions of
            the joints named in `joints`, shape (n, len(joints)); for arms.
        joints: the arm's joints, as in the names of its features.
        wheels: names of the wheels' joints in ROS -> names of angle and speed in `simulation.state`.
    """

    lidar: LidarSpec | None = None
    frames: tuple[StaticFrame, ...] = ()
    fovy: Mapping[str, float] = field(default_factory=dict)
    tool_pose: Callable[[Array], Array] | None = None
    joints: tuple[str, ...] = ()
    wheels: Mapping[str, tuple[str, str]] = field(default_factory=dict)


def static_transforms(frames: Sequence[StaticFrame], stamp: int) -> list[bytes]:
    """Return one message for ``/tf_static``; none if there is no such frame."""
    stamps = np.array([stamp])
    transforms = [
        _transform(stamps, one.parent, one.child, np.array([[*one.position, *one.rotation]])) for one in frames
    ]
    return encode(TF, {"transforms": transforms}, 1) if transforms else []


def base_transforms(part: OdometryPart, frames: Frames, values: Array) -> list[bytes]:
    """Return messages for ``/tf`` of a base that drives."""
    x, y, yaw = part.pose(frames, values).T
    still = np.zeros_like(x)
    poses = np.stack([x, y, still, np.cos(yaw / 2), still, still, np.sin(yaw / 2)], axis=1)
    transform = _transform(frames.stamps, ODOM_FRAME, FOOTPRINT_FRAME, poses)
    return encode(TF, {"transforms": [transform]}, len(x))


def tool_transforms(view: RobotView, frames: Frames, names: Sequence[str], state: Array) -> list[bytes]:
    """Return messages for ``/tf`` of an arm's tool; none if its pose is not known."""
    columns = {name: state[:, column] for column, name in enumerate(names)}
    joints = [f"{joint}.pos" for joint in view.joints]
    if set(TOOL) <= columns.keys():
        poses = np.stack([columns[name] for name in TOOL], axis=1)
    elif view.tool_pose is not None and set(joints) <= columns.keys():
        poses = view.tool_pose(np.stack([columns[name] for name in joints], axis=1))
    else:
        return []
    return encode(TF, {"transforms": [_transform(frames.stamps, ARM_FRAME, TOOL_FRAME, poses)]}, len(state))


def wheel_states(
    view: RobotView, frames: Frames, features: Mapping[str, Any], columns: Mapping[str, NDArray[Any]]
) -> list[bytes]:
    """Return messages for ``/joint_states`` of a base's wheels; none where the physics was not recorded."""
    state = columns.get(keys.PHYSICS_STATE)
    names = list(features.get(keys.PHYSICS_STATE, {}).get("names") or ())
    pairs = list(view.wheels.values())
    if state is None or not pairs or not {name for pair in pairs for name in pair} <= set(names):
        return []
    angles, speeds = ([names.index(pair[side]) for pair in pairs] for side in (0, 1))
    fields = {
        "header": header(frames.stamps),
        "name": list(view.wheels),
        "position": state[:, angles],
        "velocity": state[:, speeds],
    }
    return encode(JOINT_STATE, fields, len(state))


def camera_info(frames: Frames, frame_id: str, size: tuple[int, int], fovy: float) -> list[bytes]:
    """Return the geometry of a camera without distortion.

    Args:
        frames: which messages.
        frame_id: the camera's optical frame.
        size: height and width of its images [px].
        fovy: its vertical field of view [rad].
    """
    height, width = size
    focal = height / 2 / np.tan(fovy / 2)
    # Pixel centres are at whole numbers, so that the middle of the image lies between two of them.
    x, y = (width - 1) / 2, (height - 1) / 2
    fields = {
        "header": header(frames.stamps, frame_id),
        "height": height,
        "width": width,
        "distortion_model": "plumb_bob",
        "d": [0.0] * 5,
        "k": np.array([focal, 0, x, 0, focal, y, 0, 0, 1]),
        "r": np.eye(3).reshape(-1),
        "p": np.array([focal, 0, x, 0, 0, focal, y, 0, 0, 0, 1, 0]),
    }
    return encode(CAMERA_INFO, fields, len(frames.stamps))


def _transform(stamps: NDArray[np.int64], parent: str, child: str, poses: Array) -> dict[str, Any]:
    translation = dict(zip(("x", "y", "z"), poses[:, :3].T, strict=True))
    rotation = dict(zip(("w", "x", "y", "z"), poses[:, 3:].T, strict=True))
    return {
        "header": header(stamps, parent),
        "child_frame_id": child,
        "transform": {"translation": translation, "rotation": rotation},
    }
