"""Which frames of reference a bag's messages are in."""

from collections.abc import Sequence

import numpy as np

from bhd_lerobot.errors import DatasetError
from bhd_lerobot.ros2.messages.scan import BASE_FRAMES, last_name


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


def check_base_frame(topic: str, frame: str, given: str | None) -> None:
    """Check that odometry is of the robot's base."""
    if frame and last_name(frame) not in BASE_FRAMES and frame != given:
        raise DatasetError(
            f"The speeds of {topic} are of the frame {frame!r} (child_frame_id), not of {' or '.join(BASE_FRAMES)}. If "
            f"that is the robot's base, with x ahead, say so with --odom_frame={frame}."
        )
