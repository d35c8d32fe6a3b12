"""What is read of a bag: which topic carries which numbers of the dataset, and how they are in its messages."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.errors import ConfigError, DatasetError
from bhd_lerobot.ros2.bag.importer.diagnostics import speed_warnings
from bhd_lerobot.ros2.bag.storage.read import Messages
from bhd_lerobot.ros2.messages.base import odometry, unwrapped
from bhd_lerobot.ros2.messages.images import COMPRESSED, IMAGE
from bhd_lerobot.ros2.messages.mapping import MappingConfig, TopicFields, topics_of
from bhd_lerobot.ros2.messages.parts import header_stamps
from bhd_lerobot.ros2.messages.scan import BASE_FRAMES, ScanReader, Static, last_name
from bhd_lerobot.ros2.messages.table import IMU_TYPE, ODOMETRY_TYPE, SCAN

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Reading:
    """The messages of a topic, what reading them needs to know beside them, and where its notes go.

    Attributes:
        decoded: what is in the messages; nothing of images.
        static_lost: whether messages of ``/tf_static`` cannot be read.
    """

    topic: str
    messages: Messages
    decoded: Sequence[Any]
    static: Static
    static_lost: bool
    notes: list[str]


type Reader = Callable[[Reading], Array]
"""Returns the values in the messages of a topic, shape (n, names); masked where a message does not have one."""


@dataclass(frozen=True)
class Source:
    """What one topic carries of the dataset.

    Attributes:
        readers: type that the topic's messages may have -> what reads them.
        is_turned: whether ``/tf_static`` states how the sensor is mounted.
        angles: those of the names that are yaws, which count on beyond half a turn, and a whole turn of each.
        size: height and width that images must have [px]; 0 for any.
    """

    topic: str
    feature: str
    names: tuple[str, ...]
    readers: Mapping[str, Reader]
    meaning: str
    option: str = "--map"
    is_turned: bool = False
    angles: Mapping[str, float] = field(default_factory=dict)
    size: tuple[int, int] = (0, 0)

    @property
    def is_action(self) -> bool:
        """Whether it carries commands, which stay in force, and no readings of a sensor."""
        return self.feature == keys.ACTION


def mapped_sources(
    mapping: MappingConfig, scan_frame: str | None = None, scan_yaw: float | None = None
) -> list[Source]:
    """Return what is read for a mapping.

    Raises:
        ConfigError: a type is not known, or has no such field, or it is no number.
    """
    found = []
    for feature, section in ((keys.OBSERVATION_STATE, mapping.observation), (keys.ACTION, mapping.action)):
        place = feature.removesuffix(".state")
        numbers = {name: one for name, one in section.items() if not one.beams}
        try:
            topics = topics_of(numbers, mapping.types)
        except ConfigError as error:
            raise ConfigError(f"The mapping's {place}: {error}") from error
        for topic in topics:
            names = tuple(list(numbers)[column] for column in topic.columns)
            is_observed = feature == keys.OBSERVATION_STATE
            angles = {names[column]: turn for column, turn in topic.turns.items() if is_observed}
            readers = {topic.msgtype: partial(_fields, topic, names, angles)}
            meaning = f"{place}.{names[0]}" + f" and {len(names) - 1} more" * (len(names) > 1)
            found.append(Source(topic.topic, feature, names, readers, meaning, angles=angles))
        for name, one in section.items():
            if one.beams:
                topic_name, names = "/" + one.topic.lstrip("/"), one.names(name)
                reader = partial(_scans, ScanReader(topic_name, one.lidar, one.beams, scan_frame, scan_yaw))
                found.append(Source(topic_name, feature, names, {SCAN: reader}, f"{place}.{name}", is_turned=True))
    for name, camera in mapping.images.items():
        feature = f"{keys.OBSERVATION_IMAGES}.{name}"
        topic_name, size = "/" + camera.topic.lstrip("/"), (camera.height, camera.width)
        of_images: dict[str, Reader] = dict.fromkeys(_IMAGES, _places)
        found.append(Source(topic_name, feature, (), of_images, f"images.{name}", size=size))
    return found


def base_sources(
    mapping: MappingConfig, bare: MappingConfig, odom_frame: str | None, scan_frame: str | None, scan_yaw: float | None
) -> list[Source]:
    """Return what is read of a TurtleBot3's bag, named by the options that choose its topics.

    Args:
        mapping: of its preset, for commands with stamps.
        bare: the same for commands without.
    """
    found = []
    bare_readers = {one.feature: one.readers for one in mapped_sources(bare) if one.is_action}
    for source in mapped_sources(mapping, scan_frame, scan_yaw):
        (first, *_) = source.readers
        readers = {**source.readers, **bare_readers.get(source.feature, {})}
        if first == ODOMETRY_TYPE:
            readers = {first: partial(_odometry, readers[first], odom_frame)}
        found.append(replace(source, readers=readers, option="--cmd" if source.is_action else _OPTIONS[first]))
    return found


_IMAGES = (IMAGE, COMPRESSED)
_OPTIONS = {SCAN: "--scan", ODOMETRY_TYPE: "--odom", IMU_TYPE: "--imu", IMAGE: "--camera"}


def _places(reading: Reading) -> Array:
    """Return the places of images in the bag."""
    return reading.messages.order.astype(np.float64)[:, None]


def _fields(fields: TopicFields, names: Sequence[str], angles: Mapping[str, float], reading: Reading) -> Array:
    """Return the fields of messages; a joint state of some joints has some of them."""
    values = np.zeros((len(reading.decoded), len(names)))
    missing = np.zeros_like(values, np.bool_)
    reasons: dict[str, None] = {}
    for row, message in enumerate(reading.decoded):
        values[row], absent = fields.read_present(message)
        missing[row, list(absent)] = True
        reasons |= dict.fromkeys(absent.values())
    lacking = [name for name, column in zip(names, missing.T, strict=True) if column.all()]
    if lacking and len(values):
        raise DatasetError(
            f"No message of {reading.topic} has what {', '.join(lacking)} is read from: {' '.join(list(reasons)[:3])}"
        )
    for column, name in enumerate(names):
        if name in angles:
            rows = ~missing[:, column]
            values[rows, column] = unwrapped(values[rows, column], angles[name])
    return np.ma.masked_array(values, missing) if missing.any() else values


def _odometry(read: Reader, frame: str | None, reading: Reading) -> Array:
    """Return the fields of a base's odometry; note speeds that are not those of its pose."""
    topic, decoded = reading.topic, reading.decoded
    children = [message.child_frame_id for message in decoded]
    _check_base_frame(topic, _the_frame(topic, children), frame)
    stamps = header_stamps(decoded)  # by which they were measured; of some drivers they are not set
    measured = stamps if (np.diff(stamps) > 0).all() else reading.messages.received
    reading.notes.extend(speed_warnings(topic, measured, *odometry(decoded)))
    return read(reading)


def _scans(reader: ScanReader, reading: Reading) -> Array:
    topic, scans, notes, lidar = reading.topic, reading.decoded, reading.notes, reader.lidar
    frame = _the_frame(topic, [scan.header.frame_id for scan in scans])
    reader = replace(reader, topic=topic, static=dict(reading.static))
    rotation, source = reader.rotation(frame)
    if reading.static_lost and source not in ("/tf_static", "--scan_yaw"):
        raise DatasetError(
            f"Messages of /tf_static cannot be read, and with them may be lost how the scanner of {topic} is "
            "turned. Say where its zero points with --scan_yaw (0 is straight ahead)."
        )
    if not np.allclose(rotation, np.eye(3), atol=1e-3):
        ahead = np.degrees(np.arctan2(rotation[1, 0], rotation[0, 0]))
        over = ", upside down" if rotation[2, 2] < 0 else ""
        notes.append(f"{topic}: the scanner is turned by {ahead:.1f} degrees{over}, from {source}")
    counts = {len(scan.ranges) for scan in scans}
    if counts != {lidar.beams}:
        few = f"{min(counts)} to {max(counts)}" if len(counts) > 1 else f"{min(counts)}"
        notes.append(f"{topic}: scans of {few} beams became {lidar.beams}, each the nearest by angle")
    reach = min((scan.range_max for scan in scans if scan.range_max > 0), default=np.inf)
    if reach < lidar.range_max * (1 - 1e-6):
        notes.append(
            f"{topic}: the scanner sees to {reach:.2f} m (range_max); where nothing came back, the dataset "
            f"has {lidar.range_max:g} m all the same"
        )
    return reader.resampled(scans, rotation)


def _the_frame(topic: str, frames: Sequence[str]) -> str:
    """Return the one frame that all messages of a topic are in."""
    names, counts = np.unique(np.array(frames, dtype=str), return_counts=True)
    if len(names) > 1:
        found = ", ".join(f"{str(name)!r} in {count} messages" for name, count in zip(names, counts, strict=True))
        raise DatasetError(
            f"{topic} has messages in several frames: {found}. They come from several sensors or robots; make a bag "
            "of one of them."
        )
    return str(names[0]).lstrip("/")


def _check_base_frame(topic: str, frame: str, given: str | None) -> None:
    """Check that odometry is of the robot's base."""
    if frame and last_name(frame) not in BASE_FRAMES and frame != given:
        raise DatasetError(
            f"The speeds of {topic} are of the frame {frame!r} (child_frame_id), not of {' or '.join(BASE_FRAMES)}. If "
            f"that is the robot's base, with x ahead, say so with --odom_frame={frame}."
        )
