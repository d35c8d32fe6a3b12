"""The topics of a robot's bag as tracks: when something was measured, and what; sorted by time, judged one by one."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import LidarSpec
from bhd_lerobot.data import bag_frames as frames
from bhd_lerobot.data.bag_images import COMPRESSED, IMAGE
from bhd_lerobot.data.bag_read import Bag, Messages, Topic
from bhd_lerobot.data.resample import Times, message_times, sane
from bhd_lerobot.data.resample_scan import resampled_scans
from bhd_lerobot.data.ros2_base import BareTwistPart, GyroPart, OdometryPart, ScanPart, TwistPart, odometry
from bhd_lerobot.data.ros2_cdr import decode
from bhd_lerobot.data.ros2_parts import NANO, head_stamps, header_stamps
from bhd_lerobot.errors import DatasetError

Array = NDArray[np.float64]

_TYPES = {
    "scan": (ScanPart.msgtype,),
    "odom": (OdometryPart.msgtype,),
    "cmd": (TwistPart.msgtype, BareTwistPart.msgtype),
    "imu": (GyroPart.msgtype,),
    "camera": (IMAGE, COMPRESSED),
}
_STATIC = "/tf_static"


@dataclass(frozen=True)
class TrackOptions:
    """How a bag of a base is read.

    Attributes:
        topics: role (``scan``, ``odom``, ``cmd``, ``imu``) -> topic; only roles that are wanted.
        cameras: name of a camera -> topic.
        beams: that a scan has in the dataset.
        lidar: the scanner that the dataset is of.
        stamps: ``"auto"``, ``"header"`` or ``"receive"``.
        scan_frame, odom_frame: frames that the user says are the scanner's and the base's.
        scan_yaw: angle of the scanner in the robot [rad], if the user says it.
    """

    topics: Mapping[str, str]
    cameras: Mapping[str, str]
    beams: int
    lidar: LidarSpec
    stamps: str = "receive"
    scan_frame: str | None = None
    odom_frame: str | None = None
    scan_yaw: float | None = None


@dataclass(frozen=True)
class Track:
    """Messages of one topic, in the order in which they were written.

    Attributes:
        topic: its name.
        msgtype: their type.
        times: when they happened [ns], shape (n,).
        order: their places in the bag, shape (n,).
        values: numbers of each, shape (n, d); of a camera, its place among the topic's messages, shape (n, 1).
    """

    topic: str
    msgtype: str
    times: Times
    order: Times
    values: Array

    def part(self, mask: NDArray[np.bool_]) -> "Track":
        """Return some of its messages, sorted by time; those of the same time stay in their order."""
        rows = np.flatnonzero(mask)
        rows = rows[np.argsort(self.times[rows], kind="stable")]
        return Track(self.topic, self.msgtype, self.times[rows], self.order[rows], self.values[rows])


def read_tracks(bag: Bag, options: TrackOptions, notes: list[str]) -> dict[str, Track]:
    """Return the tracks of a bag by role; cameras' as ``camera/<name>``.

    Args:
        bag: the bag.
        options: what is wanted.
        notes: what somebody should know is added to it.

    Raises:
        DatasetError: a topic is missing, empty, of another type, or in a frame that is not known.
    """
    topics = bag.topics()
    wanted = {role: _topic(bag, topics, role, name) for role, name in options.topics.items()}
    cameras = {f"camera/{name}": _topic(bag, topics, "camera", topic) for name, topic in options.cameras.items()}
    names = {topic.name for topic in wanted.values()} | ({_STATIC} & topics.keys())
    messages = bag.read(names, {topic.name for topic in cameras.values()})
    static = frames.static_frames(messages[_STATIC].data) if _STATIC in messages else {}
    tracks = {}
    for role, topic in {**wanted, **cameras}.items():
        found = messages[topic.name]
        if not len(found.data):
            damage = "".join(f" Damaged: {problem}." for problem in bag.problems)
            raise DatasetError(f"{bag.path} has no readable message of {topic.name}.{damage}")
        stamps = _stamps(topic, found)
        times = message_times(found.received, stamps, options.stamps)
        if stamps is not None and options.stamps == "auto" and (wrong := int((~sane(found.received, stamps)).sum())):
            notes.append(
                f"{topic.name}: {wrong} of {len(times)} header stamps are not within 0.5 s of the reception; the "
                f"{'headers were' if times is stamps else 'times of reception were'} taken for all of them"
            )
        values = _values(role, topic, found.data, _Reading(options, static, notes))
        finite = (np.abs(values) < np.finfo(np.float32).max).all(axis=1)  # the dataset's numbers are float32
        if not finite.all():
            notes.append(f"{topic.name}: {int((~finite).sum())} messages with values that are not finite, left out")
        tracks[role] = Track(topic.name, topic.msgtype, times[finite], found.order[finite], values[finite])
        if not len(tracks[role].times):
            raise DatasetError(f"{bag.path}: no message of {topic.name} has finite values.")
    return tracks


def _topic(bag: Bag, topics: Mapping[str, Topic], role: str, name: str) -> Topic:
    option, types = (f"--{role}", _TYPES[role])
    if name not in topics or not topics[name].count:
        there = ", ".join(f"{one.name} ({one.msgtype}, {one.count})" for one in topics.values()) or "none"
        fitting = [one.name for one in topics.values() if one.msgtype in types and one.count]
        hint = f" Of the right type: {', '.join(fitting)}." if fitting else ""
        what = "no message of" if name in topics else "no topic"
        raise DatasetError(
            f"{bag.path} has {what} {name}, which {_MEANING[role]} is read from. Name another one with {option}."
            f"{hint} The bag has: {there}." + "".join(f" Damaged: {problem}." for problem in bag.problems)
        )
    if topics[name].msgtype not in types:
        raise DatasetError(
            f"{name} in {bag.path} is of type {topics[name].msgtype}; valid for {option}: {', '.join(types)}."
        )
    return topics[name]


_MEANING = {
    "scan": "the scan",
    "odom": "the robot's speed",
    "cmd": "the action",
    "imu": "the yaw rate of the gyroscope",
    "camera": "the picture",
}


def _stamps(topic: Topic, messages: Messages) -> Times | None:
    if topic.msgtype == BareTwistPart.msgtype:
        return None
    if topic.msgtype in _TYPES["camera"]:
        return head_stamps(topic.name, messages.data)
    return header_stamps(topic.msgtype, messages.data)


@dataclass(frozen=True)
class _Reading:
    """What decoding needs to know, and where it says what it did."""

    options: TrackOptions
    static: frames.Static
    notes: list[str]


def _values(role: str, topic: Topic, data: Sequence[bytes], reading: _Reading) -> Array:
    if role == "scan":
        return _scans(topic, data, reading)
    if role == "odom":
        children = decode(topic.msgtype, data, ("child_frame_id",))["child_frame_id"].tolist()
        frames.check_base_frame(topic.name, frames.the_frame(topic.name, children), reading.options.odom_frame)
        return np.concatenate(odometry(data), axis=1)
    if role == "cmd":
        kind = BareTwistPart if topic.msgtype == BareTwistPart.msgtype else TwistPart
        return kind(topic.name, ()).decode(data)
    if role == "imu":
        return GyroPart(topic.name, ()).decode(data)
    return np.arange(len(data), dtype=np.float64)[:, None]


def _scans(topic: Topic, data: Sequence[bytes], reading: _Reading) -> Array:
    options, notes = reading.options, reading.notes
    geometry = ("angle_min", "angle_increment", "range_min")
    found: dict[str, Any] = decode(topic.msgtype, data, ("ranges", "header.frame_id", *geometry))
    frame = frames.the_frame(topic.name, found["header.frame_id"].tolist())
    rotation, source = frames.scanner_rotation(topic.name, frame, reading.static, options.scan_frame, options.scan_yaw)
    if not np.allclose(rotation, np.eye(3), atol=1e-3):
        ahead = np.degrees(np.arctan2(rotation[1, 0], rotation[0, 0]))
        over = ", upside down" if rotation[2, 2] < 0 else ""
        notes.append(f"{topic.name}: the scanner is turned by {ahead:.1f} degrees{over}, from {source}")
    counts = {len(one) for one in found["ranges"]}
    if counts != {options.beams}:
        few = f"{min(counts)} to {max(counts)}" if len(counts) > 1 else f"{min(counts)}"
        notes.append(f"{topic.name}: scans of {few} beams became {options.beams}, each the nearest by angle")
    return resampled_scans(
        found["ranges"],
        {name: found[name] for name in geometry},
        lidar=options.lidar,
        beams=options.beams,
        rotation=rotation,
        topic=topic.name,
    )


def seconds(nanoseconds: int) -> str:
    """Return a time in words."""
    return f"{nanoseconds / NANO:.2f} s"
