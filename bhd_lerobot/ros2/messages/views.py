"""Topics for viewers: transforms, cameras' geometry, wheels. The import does not read them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import LidarSpec
from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.ros2.messages.base import BaseNoise, OdometryPart
from bhd_lerobot.ros2.messages.parts import Array, Frames, header, stamp_tree
from bhd_lerobot.ros2.messages.serialize import encode
from bhd_lerobot.ros2.messages.table import ARM_FRAME, FOOTPRINT_FRAME, JOINTS, ODOM_FRAME, TOOL, TOOL_FRAME

TF = "tf2_msgs/msg/TFMessage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"


@dataclass(frozen=True)
class StaticFrame:
    """A frame that sits still in another one.

    Attributes:
        position: of the child's origin in the parent [m].
        rotation: of the child in the parent, a unit quaternion wxyz.
    """

    parent: str
    child: str
    position: tuple[float, float, float]
    rotation: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class JointFrame(StaticFrame):
    """A frame that turns about its z axis, with a joint; `position` and `rotation` are those at zero."""

    joint: str = ""


@dataclass(frozen=True)
class RobotView:
    """What is known of a robot beside its data.

    Attributes:
        joints: frames that turn; their parents come first.
        fovy: vertical field of view of its cameras by name [rad].
        wheels: names of the wheels' joints in ROS -> names of angle and speed in `simulation.state`.
    """

    lidar: LidarSpec | None = None
    noise: BaseNoise | None = None
    frames: tuple[StaticFrame, ...] = ()
    joints: tuple[JointFrame, ...] = ()
    fovy: Mapping[str, float] = field(default_factory=dict)
    wheels: Mapping[str, tuple[str, str]] = field(default_factory=dict)


@dataclass(frozen=True)
class Motion:
    """What moves in an episode.

    Attributes:
        angles: of joints by their names in ROS [rad], each of shape (n,).
        tool: position and quaternion wxyz of an arm's tool in its base frame, shape (n, 7), where they are recorded.
    """

    angles: Mapping[str, Array]
    tool: Array | None = None

    @classmethod
    def of(cls, view: RobotView, features: Mapping[str, Any], columns: Mapping[str, NDArray[Any]]) -> Self:
        """Return what is recorded of an episode."""
        state = _columns_of(features.get(keys.OBSERVATION_STATE), columns.get(keys.OBSERVATION_STATE))
        angles = {f"{name.removesuffix('.pos')}_joint": values for name, values in state.items()}
        physics = _columns_of(features.get(keys.PHYSICS_STATE), columns.get(keys.PHYSICS_STATE))
        angles |= {joint: physics[angle] for joint, (angle, _) in view.wheels.items() if angle in physics}
        tool = np.stack([state[name] for name in TOOL], axis=1) if set(TOOL) <= state.keys() else None
        return cls({joint.joint: angles[joint.joint] for joint in view.joints if joint.joint in angles}, tool)


def _columns_of(feature: Mapping[str, Any] | None, values: NDArray[Any] | None) -> dict[str, Array]:
    if feature is None or values is None or values.ndim != 2:
        return {}
    return {name: values[:, column].astype(np.float64) for column, name in enumerate(keys.names_of(feature))}


def still_frames(view: RobotView, motion: Motion) -> list[StaticFrame]:
    """Return the frames that sit still and have a place: not those on links whose joints are not recorded."""
    lost = {joint.child for joint in view.joints if joint.joint not in motion.angles}
    found = []
    for frame in view.frames:
        if frame.parent in lost and not (frame.parent == TOOL_FRAME and motion.tool is not None):
            lost.add(frame.child)
        else:
            found.append(frame)
    return found


def moving_transforms(view: RobotView, frames: Frames, motion: Motion) -> list[bytes]:
    """Return messages for ``/tf`` of the links of a robot; none if no joint of it is recorded, nor its tool's pose."""
    transforms = []
    stamp = stamp_tree(frames.stamps)
    for joint in view.joints:
        if joint.joint in motion.angles:
            half = motion.angles[joint.joint] / 2
            w, x, y, z = joint.rotation
            c, s = np.cos(half), np.sin(half)
            turned = w * c - z * s, x * c + y * s, y * c - x * s, z * c + w * s
            transforms.append(_transform_tree(stamp, joint.parent, joint.child, joint.position, turned))
    if not transforms and motion.tool is not None:
        transforms.append(_transform(frames.stamps, ARM_FRAME, TOOL_FRAME, motion.tool))
    return encode(TF, {"transforms": transforms}, len(frames.stamps)) if transforms else []


def static_transforms(frames: Sequence[StaticFrame], stamp: int) -> list[bytes]:
    """Return one message for ``/tf_static``; none if there is no such frame."""
    stamps = np.array([stamp])
    transforms = [
        _transform(stamps, frame.parent, frame.child, np.array([[*frame.position, *frame.rotation]]))
        for frame in frames
    ]
    return encode(TF, {"transforms": transforms}, 1) if transforms else []


def base_transforms(part: OdometryPart, frames: Frames, values: Array) -> list[bytes]:
    """Return messages for ``/tf`` of a base that drives."""
    x, y, yaw = part.pose(frames, values).T
    still = np.zeros_like(x)
    poses = np.stack([x, y, still, np.cos(yaw / 2), still, still, np.sin(yaw / 2)], axis=1)
    transform = _transform(frames.stamps, ODOM_FRAME, FOOTPRINT_FRAME, poses)
    return encode(TF, {"transforms": [transform]}, len(x))


def wheel_states(
    view: RobotView, frames: Frames, features: Mapping[str, Any], columns: Mapping[str, NDArray[Any]]
) -> list[bytes]:
    """Return messages for ``/joint_states`` of a base's wheels; none where the physics was not recorded."""
    physics = _columns_of(features.get(keys.PHYSICS_STATE), columns.get(keys.PHYSICS_STATE))
    if not view.wheels or not {name for pair in view.wheels.values() for name in pair} <= physics.keys():
        return []
    angles, speeds = (np.stack([physics[pair[side]] for pair in view.wheels.values()], axis=1) for side in (0, 1))
    fields = {
        "header": header(frames.stamps),
        "name": list(view.wheels),
        "position": angles,
        "velocity": speeds,
    }
    return encode(JOINTS, fields, len(angles))


def camera_info(frames: Frames, frame_id: str, size: tuple[int, int], fovy: float) -> list[bytes]:
    """Return the geometry of a camera without distortion.

    Args:
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
    return _transform_tree(stamp_tree(stamps), parent, child, poses[:, :3].T, poses[:, 3:].T)


def _transform_tree(
    stamp: dict[str, Any], parent: str, child: str, position: Sequence[Any] | Array, rotation: Sequence[Any] | Array
) -> dict[str, Any]:
    return {
        "header": {"stamp": stamp, "frame_id": parent},
        "child_frame_id": child,
        "transform": {
            "translation": dict(zip("xyz", position, strict=True)),
            "rotation": dict(zip("wxyz", rotation, strict=True)),
        },
    }
