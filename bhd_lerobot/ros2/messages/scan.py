"""From the beams of some scanner to ours: evenly spaced, the first straight ahead, counter-clockwise.

How the scanner is mounted is known from ``/tf_static``, from options or from its frame's name.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import LidarSpec
from bhd_lerobot.errors import DatasetError
from bhd_lerobot.ros2.messages.serialize import decode
from bhd_lerobot.ros2.messages.table import FOOTPRINT_FRAME, SCAN_FRAME
from bhd_lerobot.ros2.messages.views import TF

Array = NDArray[np.float64]
Static = Mapping[str, tuple[str, Array]]
"""Frame -> its parent, and its rotation in it, shape (3, 3)."""
BASE_FRAMES = (FOOTPRINT_FRAME, "base_link")
GEOMETRY = ("angle_min", "angle_increment", "range_min", "range_max")
_MOST_RANGES = 10_000  # a multiple of those of any scanner; more would take seconds to resample
_MOST = 1.5 * 2 * np.pi  # [rad] of a scan; drivers continue a little after a whole turn, and nothing turns twice
_DEEPEST = 32  # frames between a sensor and the base
_WIDEST = np.radians(10.0)  # between a beam of ours and the one it is made of; a few beams are no view all around


def clean_ranges(ranges: NDArray[np.floating], lidar: LidarSpec, range_min: float, range_max: float = np.inf) -> Array:
    """Return ranges as the dataset has them.

    No return is 0, infinity, not a number or a negative value in drivers of real scanners; it becomes the maximum
    range, as does what is beyond the scanner's own range: by ROS's rule such a reading is none. Minus
    infinity is ROS's word for something too near. What is nearer than the scanner can see, or farther, reads its
    nearest or farthest range.

    Args:
        range_max: of the scanner [m]; one that is not positive is none.
    """
    values = np.asarray(ranges, np.float64)
    beyond = values > (range_max if range_max > 0 else np.inf)
    near = np.isneginf(values) | ((values > 0) & (values < np.fmax(range_min, lidar.range_min)))
    nothing = ~np.isfinite(values) | (values <= 0) | beyond
    return np.where(near, lidar.range_min, np.where(nothing, lidar.range_max, np.minimum(values, lidar.range_max)))


class Sweep(NamedTuple):
    """How a scan was taken: how many beams, the first one's angle, and the angle between two [rad].

    The angle between two is negative where they run clockwise.
    """

    beams: int
    angle_min: float
    angle_increment: float


@lru_cache(maxsize=4096)
def nearest_beams(sweep: Sweep, beams: int, rotation: tuple[float, ...], topic: str) -> NDArray[np.intp]:
    """Return which measured beam is nearest to each of ours, shape (beams,)."""
    count, angle_min, angle_increment = sweep
    if abs(angle_increment) * (count - 1) > _MOST:
        raise DatasetError(
            f"The {count} beams of the scans of {topic} lie {angle_increment:g} rad apart (angle_increment), which is "
            "more than a whole turn together; the driver may write degrees, or a wrong number."
        )
    angle = angle_min + angle_increment * np.arange(count)
    matrix = np.reshape(rotation, (3, 3))
    ahead, left, _ = matrix @ np.stack([np.cos(angle), np.sin(angle), np.zeros(count)])
    measured = np.arctan2(left, ahead)
    wanted = 2 * np.pi * np.arange(beams) / beams
    away = np.abs((measured[None] - wanted[:, None] + np.pi) % (2 * np.pi) - np.pi)
    nearest = away.argmin(axis=1)
    reach = max(2 * np.pi / beams, min(1.5 * abs(angle_increment), _WIDEST))
    far = away.min(axis=1) > reach + 1e-9
    if far.any():
        seen = np.degrees(abs(angle_increment) * (count - 1))
        raise DatasetError(
            f"The scans of {topic} cover {seen:.0f} degrees and have no beam within reach of {int(far.sum())} of the "
            f"{beams} that the dataset has. Where nothing was measured, a policy must not read free space: a scanner "
            "that sees all around is needed."
        )
    return nearest


def resampled_scans(
    ranges: Sequence[NDArray[np.floating]],
    geometry: Mapping[str, Array],
    *,
    lidar: LidarSpec,
    beams: int,
    rotation: Array,
    topic: str,
) -> Array:
    """Return scans with our beams, shape (n, beams) [m]; not a number where a scan is none: without beams or angles.

    Args:
        geometry: ``angle_min``, ``angle_increment`` [rad], ``range_min`` and ``range_max`` [m] of each, shape (n,).
        rotation: of the scanner in the robot, a rotation matrix, shape (3, 3).
    """
    n = len(ranges)
    result = np.empty((n, beams))
    lengths = np.array([len(scan) for scan in ranges], np.int64)
    keys = np.stack([lengths, *(geometry[name] for name in GEOMETRY)], axis=1)
    turn = tuple(rotation.reshape(-1).tolist())
    kinds, which = np.unique(keys, axis=0, return_inverse=True)
    partial = 0
    reason: DatasetError | None = None
    for kind, (count, angle_min, increment, range_min, range_max) in enumerate(kinds):
        rows = np.flatnonzero(which.reshape(-1) == kind)
        if count < 1 or not np.isfinite([angle_min, increment]).all() or (increment == 0 and beams > 1):
            result[rows] = np.nan
            continue
        try:
            beam = nearest_beams(Sweep(int(count), float(angle_min), float(increment)), beams, turn, topic)
        except DatasetError as error:
            # A driver that lost a packet sends a part of a turn: that scan is lost. A scanner that sees a part of the
            # world always does.
            partial += len(rows)
            reason = error
            result[rows] = np.nan
            continue
        block = _without_holes(np.stack([np.asarray(ranges[row], np.float64) for row in rows]))
        result[rows] = clean_ranges(block[:, beam], lidar, float(range_min), float(range_max))
    if reason is not None and 2 * partial > n:
        raise reason
    return result


def _without_holes(block: Array) -> Array:
    """Fill single beams without a measurement from their neighbours, shape (n, m).

    Drivers that sort points into bins leave some empty, which is not a number, and not free space. What is missing in a
    row of more than two is no such bin.
    """
    empty = np.isnan(block)
    if not empty.any():
        return block
    middle = empty & np.roll(empty, 1, axis=1) & np.roll(empty, -1, axis=1)  # of three in a row
    hole = empty & ~(middle | np.roll(middle, 1, axis=1) | np.roll(middle, -1, axis=1))
    before, after = np.roll(block, 1, axis=1), np.roll(block, -1, axis=1)
    return np.where(hole, np.where(np.isnan(before), after, before), block)


# --- how a scanner is mounted -----------------------------------------------------------------------------------------


def static_frames(messages: Sequence[bytes]) -> tuple[dict[str, tuple[str, Array]], int]:
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


def static_topics(scan: str) -> tuple[str, str]:
    """Return the topics that may say how the scanner is mounted: that of all robots, and what counts more, its own."""
    return "/tf_static", f"{scan.rpartition('/')[0]}/tf_static"


def static_of(scan: str, static: Mapping[str, Static]) -> dict[str, tuple[str, Array]]:
    """Return the transforms that count for a scanner, of those by their topics."""
    return {frame: place for name in static_topics(scan) for frame, place in static.get(name, {}).items()}


@dataclass
class ScanReader:
    """Ranges [m] of our beams from the scans of a scanner, whatever its beams and however it is mounted.

    Attributes:
        yaw: the scanner's angle in the robot [rad], if the user gives it.
        prefix: what the names of the options begin with by which the user does.
    """

    topic: str
    lidar: LidarSpec
    width: int
    frame: str | None = None
    yaw: float | None = None
    prefix: str = "--"
    static: dict[str, tuple[str, Array]] = field(default_factory=dict)

    def rotation(self, frame: str) -> tuple[Array, str]:
        """Return how a scanner with this frame is turned in the robot, shape (3, 3), and where that is known from."""
        rotation = _from_base(frame, self.static)
        is_given = self.frame in (frame, last_name(frame))
        if rotation is None and not is_given and last_name(frame) != SCAN_FRAME:
            raise DatasetError(
                f"The scans of {self.topic} are in the frame {frame!r}, whose rotation in the robot is not known: it "
                f"is not {SCAN_FRAME!r}, and /tf_static has no way from {' or '.join(BASE_FRAMES)} to it. Say that it "
                f"is the scanner with {self.prefix}scan_frame={frame}, and where its zero points with "
                f"{self.prefix}scan_yaw (0 is straight ahead)."
            )
        if self.yaw is not None:
            return _matrix(np.array([np.cos(self.yaw / 2), 0.0, 0.0, np.sin(self.yaw / 2)])), f"{self.prefix}scan_yaw"
        if rotation is not None:
            return rotation, "/tf_static"
        return np.eye(3), f"{self.prefix}scan_frame" if is_given else "its name"

    def resampled(self, scans: Sequence[Any], rotation: Array) -> Array:
        """Return scans of a scanner that is turned like this, shape (n, width); not a number where a scan is none."""
        return resampled_scans(
            [scan.ranges for scan in scans],
            {name: np.array([getattr(scan, name) for scan in scans], np.float64) for name in GEOMETRY},
            lidar=self.lidar,
            beams=self.width,
            rotation=rotation,
            topic=self.topic,
        )

    def read(self, message: Any) -> Array:
        """Return the ranges of one scan, shape (width,)."""
        if len(message.ranges) > _MOST_RANGES:
            raise DatasetError(f"the scan has {len(message.ranges)} ranges; at most {_MOST_RANGES} are read")
        rotation, _ = self.rotation(message.header.frame_id.lstrip("/"))
        [ranges] = self.resampled([message], rotation)
        if np.isnan(ranges).any():
            raise DatasetError(f"the scan has {len(message.ranges)} ranges, or no angles")
        return ranges


def _from_base(frame: str, static: Static) -> Array | None:
    rotation = np.eye(3)
    for _ in range(_DEEPEST):
        if last_name(frame) in BASE_FRAMES:
            return rotation
        if frame not in static:
            return None
        frame, turn = static[frame][0], static[frame][1]
        rotation = turn @ rotation
    return None


def last_name(frame: str) -> str:
    """Return a frame's name without the robot's in front of it."""
    return frame.rsplit("/", 1)[-1]


def _quaternion(transform: Any) -> Array:
    turn = transform.transform.rotation
    return np.array([turn.w, turn.x, turn.y, turn.z])


def _matrix(quaternion: Array) -> Array:
    """Return the rotation matrix of a quaternion wxyz; one that was never set, all zeros, is no rotation."""
    from scipy.spatial.transform import Rotation  # not at the start of every command

    return Rotation.from_quat(quaternion, scalar_first=True).as_matrix() if quaternion.any() else np.eye(3)
