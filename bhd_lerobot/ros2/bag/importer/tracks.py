"""The topics of a robot's bag as tracks: when something was measured, and what; sorted by time, judged one by one."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.errors import DatasetError
from bhd_lerobot.ros2.bag.importer.diagnostics import pace, pace_warnings
from bhd_lerobot.ros2.bag.importer.options import ImportOptions
from bhd_lerobot.ros2.bag.importer.resample import Times, apart, message_times, sane
from bhd_lerobot.ros2.bag.importer.sources import Reading, Source
from bhd_lerobot.ros2.bag.importer.topics import other_form, publisher_notes, wanted_topics
from bhd_lerobot.ros2.bag.storage.read import Bag, Messages, Topic
from bhd_lerobot.ros2.messages.mapping import has_header
from bhd_lerobot.ros2.messages.parts import NANO, head_stamps, header_stamps
from bhd_lerobot.ros2.messages.scan import static_frames, static_of, static_topics
from bhd_lerobot.ros2.messages.serialize import decode
from bhd_lerobot.ros2.messages.table import JOINTS

Array = NDArray[np.float64]

MOST_LOST = 0.1
"""Share of a topic's messages that may be unreadable. Beyond it is no accident, and what is left is no record."""

_HEADER_BYTES = 12  # of a message: what it is serialised as, and the stamp
_UNSET = "the orientation 0, 0, 0, 0, which is no rotation"
_LEAP, _OFTEN = 0.05, 3  # of at least two joints [rad, m]; a posture that is not 0 leaps so often at the least
_APART_NS = NANO // 2  # of two topics' clocks: a scan is stamped at its first ray, and a network delays


@dataclass(frozen=True)
class Track:
    """Messages of one topic that carry the same numbers, in the order in which they were written.

    Attributes:
        order: their places in the bag, shape (n,).
        values: numbers of each, shape (n, d); of a camera, its place in the bag, shape (n, 1).
        stamps: of their headers [ns], shape (n,); None if they have none.
    """

    source: Source
    topic: str
    msgtype: str
    times: Times
    order: Times
    values: Array
    stamps: Times | None
    names: tuple[str, ...] = ()

    @property
    def is_action(self) -> bool:
        """Whether it carries commands."""
        return self.source.is_action

    def part(self, mask: NDArray[np.bool_]) -> "Track":
        """Return some of its messages, sorted by time; those of the same time stay in their order."""
        rows = np.flatnonzero(mask)
        return self.rows(rows[np.argsort(self.times[rows], kind="stable")])

    def rows(self, rows: NDArray[np.intp]) -> "Track":
        """Return some of its messages, in this order."""
        times = self.times[rows]
        stamps = times if self.stamps is self.times else None if self.stamps is None else self.stamps[rows]
        return replace(self, times=times, order=self.order[rows], values=self.values[rows], stamps=stamps)


def read_tracks(bag: Bag, options: ImportOptions, known: Mapping[str, Messages], notes: list[str]) -> list[Track]:
    """Return the tracks of a bag, in the order of what is read of it.

    Args:
        known: messages of some topics, which are not read again.
    """
    wanted = wanted_topics(bag, options.sources)
    notes += publisher_notes(bag, wanted)
    turned = {name for source, _ in wanted if source.is_turned for name in static_topics(source.topic)}
    latched = sorted((turned | {other_form(name) for name in turned}) & bag.topics.keys())
    images = {topic.name for source, topic in wanted if not source.names}
    messages = dict(known)
    if unread := ({topic.name for _, topic in wanted} | {*latched}) - known.keys():
        messages |= bag.read(unread - images, unread & images)
    static: dict[str, dict[str, Any]] = {}
    lost = 0
    for name in latched:
        frames, unreadable = static_frames(list(messages[name].data))
        static.setdefault(f"/{name.lstrip('/')}", {}).update(frames)
        lost += unreadable
    if lost:
        bag.problems.append(f"{bag.path.name}: {lost} messages of /tf_static cannot be read, and are left out")
    tracks: list[Track] = []
    paces, clocks, decoded = {}, {}, {}
    for source, topic in wanted:
        if not len(messages[topic.name].data):
            damage = "".join(f" Damaged: {problem}." for problem in bag.problems)
            raise DatasetError(f"{bag.path} has no readable message of {topic.name}.{damage}")
        if topic.name not in decoded:
            decoded[topic.name] = _decoded(bag, topic, messages[topic.name], is_image=topic.name in images)
        found, content = decoded[topic.name]
        stamps = _stamps(topic, found, content, is_image=topic.name in images)
        if stamps is not None and not source.is_action:
            paces[topic.name] = pace(found.received, stamps)
        times = message_times(found.received, stamps, options.stamps)
        if stamps is not None and options.stamps == "auto" and (wrong := int((~sane(found.received, stamps)).sum())):
            notes.append(
                f"{topic.name}: {wrong} of {len(times)} header stamps are not within 0.5 s of the reception; the "
                f"{'headers were' if times is stamps else 'times of reception were'} taken for all of them"
            )
        clocks[topic.name] = (found.received, times)
        try:
            mounted = static_of(f"/{topic.name.lstrip('/')}", static)
            values = source.readers[topic.msgtype](Reading(topic.name, found, content, mounted, lost > 0, notes))
        except DatasetError as error:
            raise DatasetError(f"{bag.path}: {error}") from error
        track = Track(source, topic.name, topic.msgtype, times, found.order, values, stamps, source.names)
        tracks += [_of_the_robot(_finite(bag, one, notes), notes) for one in _complete(track)]
    notes += pace_warnings(paces)
    _check_one_time(bag, wanted[0][1].name, clocks)
    return tracks


def _complete(track: Track) -> list[Track]:
    """Return a track for each set of numbers that come together: a topic may have messages of some joints each."""
    missing = np.ma.getmaskarray(track.values)
    if not missing.any():
        return [track]
    tracks = []
    patterns, which = np.unique(missing, axis=1, return_inverse=True)
    for number, pattern in enumerate(patterns.T):
        columns = np.flatnonzero(which.reshape(-1) == number)
        part = track.rows(np.flatnonzero(~pattern))
        names = tuple(track.names[column] for column in columns)
        tracks.append(replace(part, values=np.asarray(part.values[:, columns]), names=names))
    return tracks


def _finite(bag: Bag, track: Track, notes: list[str]) -> Track:
    """Return a track without the messages whose numbers are none; note how many there were."""
    values = np.asarray(track.values)
    fits = np.abs(values) < np.finfo(np.float32).max  # the dataset's numbers are float32
    finite = np.logical_and.reduce(fits, axis=1)
    angles = [column for column, name in enumerate(track.names) if name in track.source.angles]
    others = [column for column in range(values.shape[1]) if column not in angles]
    unset = ~finite & fits[:, others].all(axis=1) & np.isnan(values[:, angles]).any(axis=1)
    what = "are no scan of a whole turn" if track.source.is_turned else "with values that are not finite"
    for lost, text in ((~finite & ~unset, what), (unset, f"have {_UNSET}")):
        if lost.any():
            notes.append(f"{track.topic}: {int(lost.sum())} of {len(finite)} messages {text}, left out")
    if unset.all():
        raise DatasetError(
            f"{bag.path}: all messages of {track.topic} have {_UNSET}: its driver fills in no pose. Leave out "
            + ("--odometry, or name another topic with --odom." if track.source.option == "--odom" else "the feature.")
        )
    if not finite.any():
        raise DatasetError(f"{bag.path}: no message of {track.topic} has finite values.")
    return replace(track, values=values).rows(np.flatnonzero(finite))


def _of_the_robot(track: Track, notes: list[str]) -> Track:
    """Return a track of joints without the one posture that comes between the robot's again and again; note how often.

    So it is where joint_state_publisher runs beside a robot's driver: it has all joints at 0 as long as nobody moves
    its sliders.
    """
    positions = [column for column, name in enumerate(track.names) if name.endswith(".pos")]
    if track.msgtype != JOINTS or track.is_action or len(positions) < 2 or not len(track.values):
        return track
    values = track.values[:, positions]
    postures, which, counts = np.unique(values, axis=0, return_inverse=True, return_counts=True)
    which = which.reshape(-1)
    zero = np.flatnonzero(~postures.any(axis=1)).tolist()
    kept = np.ones(len(values), np.bool_)
    for posture in {*zero, int(counts.argmax())}:
        changes = np.diff(which == posture, prepend=False, append=False)
        begins, ends = np.flatnonzero(changes).reshape(-1, 2).T
        inner = (begins > 0) & (ends < len(values))
        begins, ends = begins[inner], ends[inner]
        before, after = values[begins - 1], values[ends]
        away = np.abs(before - postures[posture])
        leaps = ((away > _LEAP).sum(axis=1) >= 2) & (np.abs(after - before).max(axis=1) < away.max(axis=1) / 2)
        if int(leaps.sum()) < (1 if posture in zero else _OFTEN):
            continue
        for begin, end in zip(begins[leaps].tolist(), ends[leaps].tolist(), strict=True):
            kept[begin:end] = False
        where = "0" if posture in zero else np.array2string(postures[posture], precision=3, separator=", ")
        notes.append(
            f"{track.topic}: {int((which[~kept] == posture).sum())} of {len(kept)} messages have all joints at {where} "
            "between others, as of a joint_state_publisher beside the robot's driver; left out"
        )
    return track.rows(np.flatnonzero(kept))


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


def _decoded(bag: Bag, topic: Topic, messages: Messages, *, is_image: bool) -> tuple[Messages, list[Any]]:
    """Return the messages of a topic that can be read, and what is in them; of images, nothing is.

    The others are as if they had been lost, and are counted. An image that is cut off is found when it is decoded.
    """
    decoded: list[Any] = []
    mask = np.ones(len(messages.data), np.bool_)
    reason = ""
    for place, data in enumerate(messages.data):
        try:
            if is_image and len(data) < _HEADER_BYTES:
                raise DatasetError(f"An image's message ends after {len(data)} bytes.")
            decoded += [] if is_image else [decode(topic.msgtype, data)]
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


def _stamps(topic: Topic, messages: Messages, decoded: Sequence[Any], *, is_image: bool) -> Times | None:
    if not has_header(topic.msgtype):
        return None
    return head_stamps(messages.data) if is_image else header_stamps(decoded)


def seconds(nanoseconds: int) -> str:
    """Return a time as text."""
    return f"{nanoseconds / NANO:.2f} s"
