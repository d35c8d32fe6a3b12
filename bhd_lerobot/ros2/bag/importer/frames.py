"""Which frames of reference a bag's messages are in, and how the scanner is turned in the robot."""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.errors import DatasetError
from bhd_lerobot.ros2.messages.base import FOOTPRINT_FRAME, SCAN_FRAME
from bhd_lerobot.ros2.messages.serialize import decode
from bhd_lerobot.ros2.messages.views import TF

Array = NDArray[np.float64]
Static = Mapping[str, tuple[str, Array]]
"""Frame -> its parent, and its rotation in it, shape (3, 3)."""

BASE_FRAMES = (FOOTPRINT_FRAME, "base_link")
_DEEPEST = 32  # frames between a sensor and the base


def static_frames(messages: Sequence[bytes]) -> tuple[Static, int]:
    """Return the transforms of ``/tf_static``, and how many of its messages cannot be read."""
    frames: dict[str, tuple[str, Array]] = {}
    lost = 0
    for message, times in Counter(messages).items():  # a latched message may be there many times
        try:
            transforms = decode(TF, message).transforms
        except DatasetError:
            transforms = None
        if transforms is None or not np.isfinite([_quaternion(transform) for transform in transforms]).all():
            lost += times
            continue
        for transform in transforms:
            frames[transform.child_frame_id.lstrip("/")] = (
                transform.header.frame_id.lstrip("/"),
                _matrix(_quaternion(transform)),
            )
    return frames, lost


def the_frame(topic: str, frames: Sequence[str]) -> str:
    """Return the one frame that all messages of a topic are in."""
    names, counts = np.unique(np.array(frames, dtype=str), return_counts=True)
    if len(names) > 1:
        found = ", ".join(f"{str(name)!r} in {count} messages" for name, count in zip(names, counts, strict=True))
        raise DatasetError(
            f"{topic} has messages in several frames: {found}. They come from several sensors or robots; make a bag "
            "of one of them."
        )
    return str(names[0]).lstrip("/")


def scanner_rotation(topic: str, frame: str, static: Static, given: str | None, yaw: float | None) -> tuple[Array, str]:
    """Return how the scanner is turned in the robot, shape (3, 3), and where that is known from.

    Args:
        frame: that they are in.
        given: the scanner's frame, if the user names it.
        yaw: the scanner's angle in the robot [rad], if the user gives it.
    """
    rotation = _from_base(frame, static)
    known = rotation is not None or frame == given or _last(frame) == SCAN_FRAME
    if not known:
        raise DatasetError(
            f"The scans of {topic} are in the frame {frame!r}, whose rotation in the robot is not known: it is "
            f"not {SCAN_FRAME!r}, and /tf_static has no way from {' or '.join(BASE_FRAMES)} to it. Say that it is the "
            f"scanner with --scan_frame={frame}, and where its zero points with --scan_yaw (0 is straight ahead)."
        )
    if yaw is not None:
        return _matrix(np.array([np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)])), "--scan_yaw"
    if rotation is not None:
        return rotation, "/tf_static"
    return np.eye(3), "its name" if frame != given else "--scan_frame"


def check_base_frame(topic: str, frame: str, given: str | None) -> None:
    """Check that odometry is of the robot's base."""
    if frame and _last(frame) not in BASE_FRAMES and frame != given:
        raise DatasetError(
            f"The speeds of {topic} are of the frame {frame!r} (child_frame_id), not of {' or '.join(BASE_FRAMES)}. If "
            f"that is the robot's base, with x ahead, say so with --odom_frame={frame}."
        )


def _from_base(frame: str, static: Static) -> Array | None:
    rotation = np.eye(3)
    for _ in range(_DEEPEST):
        if _last(frame) in BASE_FRAMES:
            return rotation
        if frame not in static:
            return None
        frame, turn = static[frame][0], static[frame][1]
        rotation = turn @ rotation
    return None


def _last(frame: str) -> str:
    """Return a frame's name without the robot's in front of it."""
    return frame.rsplit("/", 1)[-1]


def _quaternion(transform: Any) -> Array:
    turn = transform.transform.rotation
    return np.array([turn.w, turn.x, turn.y, turn.z])


def _matrix(quaternion: Array) -> Array:
    """Return the rotation matrix of a quaternion wxyz; one that was never set, all zeros, is no rotation."""
    from scipy.spatial.transform import Rotation  # not at the start of every command

    return Rotation.from_quat(quaternion, scalar_first=True).as_matrix() if quaternion.any() else np.eye(3)
