"""The topics of a robot's bag as tracks: when something was measured, and what; sorted by time, judged one by one."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.errors import DatasetError
from bhd_lerobot.ros2.bag.importer import frames
from bhd_lerobot.ros2.bag.importer.diagnostics import pace, pace_warnings, speed_warnings
from bhd_lerobot.ros2.bag.importer.options import ImportOptions
from bhd_lerobot.ros2.bag.importer.resample import Times, apart, message_times, sane
from bhd_lerobot.ros2.bag.importer.topics import TYPES, exported_topic, publisher_notes, static_topics, wanted_topics
from bhd_lerobot.ros2.bag.storage.read import Bag, Messages, Topic
from bhd_lerobot.ros2.messages.base import GYRO, ODOMETRY, TWIST, BareTwistPart, GyroPart, TwistPart, odometry
from bhd_lerobot.ros2.messages.parts import NANO, WXYZ, head_stamps, header_stamps, numbers
from bhd_lerobot.ros2.messages.scan import GEOMETRY, resampled_scans
from bhd_lerobot.ros2.messages.serialize import decode

Array = NDArray[np.float64]

MOST_LOST = 0.1
"""Share of a topic's messages that may be unreadable. Beyond it is no accident, and what is left is no record."""

_HEADER_BYTES = 12  # of a message: what it is serialised as, and the stamp
_UNSET = "the orientation 0, 0, 0, 0, which is no rotation"
_APART_NS = NANO // 2  # of two topics' clocks: a scan is stamped at its first ray, and a network delays


@dataclass(frozen=True)
class Track:
    """Messages of one topic, in the order in which they were written.

    Attributes:
        times: when they happened [ns], shape (n,).
        order: their places in the bag, shape (n,).
        values: numbers of each, shape (n, d); of a camera, its place in the bag, shape (n, 1).
        stamps: of their headers [ns], shape (n,); None if they have none.
    """

    topic: str
    msgtype: str
    times: Times
    order: Times
    values: Array
    stamps: Times | None
    names: tuple[str, ...] = ()

    def part(self, mask: NDArray[np.bool_]) -> "Track":
        """Return some of its messages, sorted by time; those of the same time stay in their order."""
        rows = np.flatnonzero(mask)
        return self.rows(rows[np.argsort(self.times[rows], kind="stable")])

    def rows(self, rows: NDArray[np.intp]) -> "Track":
        """Return some of its messages, in this order."""
        times = self.times[rows]
        stamps = times if self.stamps is self.times else None if self.stamps is None else self.stamps[rows]
        return replace(self, times=times, order=self.order[rows], values=self.values[rows], stamps=stamps)


def read_tracks(bag: Bag, options: ImportOptions, notes: list[str]) -> dict[str, Track]:
    """Return the tracks of a bag by role; cameras' as ``camera/<name>``."""
    wanted = wanted_topics(bag, {role: topic for role, topic in options.topic_of.items() if role not in options.parts})
    cameras = {role: wanted.pop(role) for role in list(wanted) if role.startswith("camera/")}
    wanted |= {role: exported_topic(bag, role, part) for role, part in options.parts.items()}
    notes += publisher_notes(bag, {**wanted, **cameras})
    latched = sorted(static_topics(options.topics["scan"]) & bag.topics.keys()) if "scan" in options.topics else []
    names = {topic.name for topic in wanted.values()} | {*latched}
    messages = bag.read(names, {topic.name for topic in cameras.values()})
    static, lost = frames.static_frames([one for name in latched for one in messages[name].data])
    if lost:
        bag.problems.append(f"{bag.path.name}: {lost} messages of /tf_static cannot be read, and are left out")
    tracks, paces, clocks = {}, {}, {}
    for role, topic in {**wanted, **cameras}.items():
        if not len(messages[topic.name].data):
            damage = "".join(f" Damaged: {problem}." for problem in bag.problems)
            raise DatasetError(f"{bag.path} has no readable message of {topic.name}.{damage}")
        found, decoded = _decoded(bag, topic, messages[topic.name])
        stamps = _stamps(topic, found, decoded)
        if stamps is not None and role != "cmd":
            paces[topic.name] = pace(found.received, stamps)
        times = message_times(found.received, stamps, options.stamps)
        if stamps is not None and options.stamps == "auto" and (wrong := int((~sane(found.received, stamps)).sum())):
            notes.append(
                f"{topic.name}: {wrong} of {len(times)} header stamps are not within 0.5 s of the reception; the "
                f"{'headers were' if times is stamps else 'times of reception were'} taken for all of them"
            )
        clocks[topic.name] = (found.received, times)
        values = _values(role, topic, found, decoded, _Reading(options, static, lost > 0, notes))
        fits = np.abs(values) < np.finfo(np.float32).max  # the dataset's numbers are float32
        finite = np.logical_and.reduce(fits, axis=1)
        unset = _unset(role, decoded, options) & fits[:, :-1].all(axis=1) & ~finite
        for lost, what in (
            (~finite & ~unset, "are no scan of a whole turn" if role == "scan" else "with values that are not finite"),
            (unset, f"have {_UNSET}"),
        ):
            if lost.any():
                notes.append(f"{topic.name}: {int(lost.sum())} of {len(finite)} messages {what}, left out")
        track = Track(topic.name, topic.msgtype, times, found.order, values, stamps, _names(role, options))
        track = track.rows(np.flatnonzero(finite))
        if unset.all():
            raise DatasetError(
                f"{bag.path}: all messages of {topic.name} have {_UNSET}: its driver fills in no pose. Leave out "
                "--odometry, or name another topic with --odom."
            )
        if not len(track.times):
            raise DatasetError(f"{bag.path}: no message of {topic.name} has finite values.")
        tracks[role] = track
    notes += pace_warnings(paces)
    _check_one_time(bag, wanted["odom" if "odom" in wanted else next(iter(wanted))].name, clocks)
    return tracks


def _unset(role: str, decoded: Sequence[Any], options: ImportOptions) -> NDArray[np.bool_]:
    """Return which messages have an orientation that was never set, shape (n,), or, of other topics, (1,)."""
    if role != "odom" or not options.pose:
        return np.zeros(1, np.bool_)
    return ~np.any(numbers([message.pose.pose.orientation for message in decoded], WXYZ), axis=1)


def _check_one_time(bag: Bag, reference: str, clocks: Mapping[str, tuple[Times, Times]]) -> None:
    """Check that the messages of all topics are of one time."""
    for topic, clock in clocks.items():
        ahead = apart(clock, clocks[reference])
        if abs(ahead) > _APART_NS:
            raise DatasetError(
                f"{bag.path}: when they were received together, {topic} is {seconds(abs(ahead))} "
                f"{'ahead of' if ahead > 0 else 'behind'} {reference}. Their stamps are of different clocks, so "
                "it is not known which command belongs to which scan; --stamps=receive takes the recorder's for all."
            )


def _names(role: str, options: ImportOptions) -> tuple[str, ...]:
    if role in options.parts:
        return options.parts[role].names
    scan = tuple(f"scan_{beam:03d}.pos" for beam in range(options.beams))
    return {"scan": scan, "odom": TWIST + ODOMETRY * options.pose, "imu": GYRO, "cmd": TWIST}.get(role, ())


def _decoded(bag: Bag, topic: Topic, messages: Messages) -> tuple[Messages, list[Any]]:
    """Return the messages of a topic that can be read, and what is in them; of cameras, nothing is.

    The others are as if they had been lost, and are counted. An image that is cut off is found when it is decoded.
    """
    is_camera = topic.msgtype in TYPES["camera"]
    decoded: list[Any] = []
    mask = np.ones(len(messages.data), np.bool_)
    reason = ""
    for place, data in enumerate(messages.data):
        try:
            if is_camera and len(data) < _HEADER_BYTES:
                raise DatasetError(f"An image's message ends after {len(data)} bytes.")
            decoded += [] if is_camera else [decode(topic.msgtype, data)]
        except DatasetError as error:
            mask[place] = False
            reason = reason or str(error)
    lost, total = int((~mask).sum()), len(mask)
    if not lost:
        return messages, decoded
    what = f"{lost} of the {total} messages of {topic.name} cannot be read"
    if lost > MOST_LOST * total:
        raise DatasetError(
            f"{bag.path}: {what}, which is more than {100 * MOST_LOST:.0f} %: too many to continue without them. The "
            f"first: {reason}"
        )
    bag.problems.append(f"{bag.path.name}: {what}, and are left out as if they had been lost; the first: {reason}")
    return messages.part(mask), decoded


def _stamps(topic: Topic, messages: Messages, decoded: Sequence[Any]) -> Times | None:
    if topic.msgtype == BareTwistPart.msgtype:
        return None
    return head_stamps(messages.data) if topic.msgtype in TYPES["camera"] else header_stamps(decoded)


@dataclass(frozen=True)
class _Reading:
    """What decoding needs to know, and where its notes go."""

    options: ImportOptions
    static: frames.Static
    static_lost: bool
    notes: list[str]


def _values(role: str, topic: Topic, messages: Messages, decoded: list[Any], reading: _Reading) -> Array:
    if role in reading.options.parts:
        return reading.options.parts[role].decode(decoded)
    if role == "scan":
        return _scans(topic, decoded, reading)
    if role == "odom":
        children = [message.child_frame_id for message in decoded]
        frames.check_base_frame(topic.name, frames.the_frame(topic.name, children), reading.options.odom_frame)
        speeds, pose = odometry(decoded)
        stamps = header_stamps(decoded)  # by which they were measured; of some drivers they are not set
        measured = stamps if (np.diff(stamps) > 0).all() else messages.received
        reading.notes.extend(speed_warnings(topic.name, measured, speeds, pose))
        return np.concatenate([speeds, pose], axis=1) if reading.options.pose else speeds
    if role == "cmd":
        kind = BareTwistPart if topic.msgtype == BareTwistPart.msgtype else TwistPart
        return kind(topic.name, ()).decode(decoded)
    if role == "imu":
        return GyroPart(topic.name, ()).decode(decoded)
    return messages.order.astype(np.float64)[:, None]


def _scans(topic: Topic, scans: Sequence[Any], reading: _Reading) -> Array:
    options, notes = reading.options, reading.notes
    frame = frames.the_frame(topic.name, [scan.header.frame_id for scan in scans])
    rotation, source = frames.scanner_rotation(topic.name, frame, reading.static, options.scan_frame, options.scan_yaw)
    if reading.static_lost and source not in ("/tf_static", "--scan_yaw"):
        raise DatasetError(
            f"Messages of /tf_static cannot be read, and with them may be lost how the scanner of {topic.name} is "
            "turned. Say where its zero points with --scan_yaw (0 is straight ahead)."
        )
    if not np.allclose(rotation, np.eye(3), atol=1e-3):
        ahead = np.degrees(np.arctan2(rotation[1, 0], rotation[0, 0]))
        over = ", upside down" if rotation[2, 2] < 0 else ""
        notes.append(f"{topic.name}: the scanner is turned by {ahead:.1f} degrees{over}, from {source}")
    counts = {len(scan.ranges) for scan in scans}
    if counts != {options.beams}:
        few = f"{min(counts)} to {max(counts)}" if len(counts) > 1 else f"{min(counts)}"
        notes.append(f"{topic.name}: scans of {few} beams became {options.beams}, each the nearest by angle")
    reach = min((scan.range_max for scan in scans if scan.range_max > 0), default=np.inf)
    if reach < options.lidar.range_max * (1 - 1e-6):
        notes.append(
            f"{topic.name}: the scanner sees to {reach:.2f} m (range_max); where nothing came back, the dataset "
            f"has {options.lidar.range_max:g} m all the same"
        )
    return resampled_scans(
        [scan.ranges for scan in scans],
        {name: np.array([getattr(scan, name) for scan in scans]) for name in GEOMETRY},
        lidar=options.lidar,
        beams=options.beams,
        rotation=rotation,
        topic=topic.name,
    )


def seconds(nanoseconds: int) -> str:
    """Return a time as text."""
    return f"{nanoseconds / NANO:.2f} s"
