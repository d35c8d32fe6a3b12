"""From bags that `bag_export` wrote to the dataset that they were made from: every frame, every column, bit by bit."""

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.datasets.format.identity import default_root
from bhd_lerobot.datasets.format.schema import LANGUAGE
from bhd_lerobot.datasets.format.video import VideoSettings
from bhd_lerobot.datasets.writer.recorder import DatasetRecorder
from bhd_lerobot.errors import DatasetError, DatasetMismatchError
from bhd_lerobot.rosbag.exporter.episode import (
    OUTCOME_COLUMNS,
    OUTCOME_TOPIC,
    STATE_COLUMNS,
    STATE_TOPIC,
    image_topic,
)
from bhd_lerobot.rosbag.importer.dataset import ImportReport, all_or_nothing
from bhd_lerobot.rosbag.importer.headers import REMEDY, episode_headers
from bhd_lerobot.rosbag.messages import types
from bhd_lerobot.rosbag.messages.base import BareTwistPart, OdometryPart, ScanPart
from bhd_lerobot.rosbag.messages.cdr_read import decode
from bhd_lerobot.rosbag.messages.images import COMPRESSED, IMAGE, decode_image
from bhd_lerobot.rosbag.messages.parts import NANO, Part, head_stamps, header_stamps, own_topic
from bhd_lerobot.rosbag.messages.split import PARTS
from bhd_lerobot.rosbag.storage import checksum
from bhd_lerobot.rosbag.storage.read import Bag, Picker

_SAME = ("robot_type", "fps", "features", "recording", "video")


def restore(bags: Sequence[Bag], root: Path | str | None, repo_id: str) -> ImportReport:
    """Make a dataset of bags that `bag_export` wrote; the whole of it, or nothing.

    Args:
        bags: in the order of the episodes.
        root: where to put it; LeRobot's default place if None.
        repo_id: its name.

    Raises:
        DatasetError: a message is missing, or is not what was written.
        DatasetMismatchError: the bags are of different datasets.
        DatasetExistsError: `root` exists.
    """
    report = ImportReport(Path(root) if root is not None else default_root(repo_id))
    first: dict[str, Any] | None = None
    recorder: DatasetRecorder | None = None
    with all_or_nothing(report.root) as (folder, made):
        for bag in bags:
            episodes = _BagEpisodes(bag)
            for episode in episodes.all():
                if first is None or recorder is None:
                    first, recorder = episode, made(_create(episode, folder, repo_id))
                differing = [key for key in _SAME if episode[key] != first[key]]
                if differing:
                    raise DatasetMismatchError(
                        f"{bag.path} holds an episode whose {differing[0]} differs from that of the first one: "
                        f"{_short(episode[differing[0]])} instead of {_short(first[differing[0]])}. Import bags of "
                        "one dataset at a time."
                    )
                report.frames += episodes.save(episode, recorder)
                report.episodes += 1
            report.problems += bag.problems
        if recorder is None:
            raise DatasetError("There is no bag to import.")
    return report


def _create(episode: Mapping[str, Any], root: Path, repo_id: str) -> DatasetRecorder:
    features = {
        key: {name: value for name, value in feature.items() if name != "info"}
        for key, feature in episode["features"].items()
    }
    return DatasetRecorder.create(
        repo_id,
        episode["fps"],
        features,
        robot_type=episode["robot_type"],
        root=root,
        recording=episode["recording"],
        video=VideoSettings(**episode["video"]) if episode["video"] else None,
    )


class _BagEpisodes:
    """The episodes of one bag, with all messages but pictures in memory."""

    def __init__(self, bag: Bag) -> None:
        self._bag = bag
        self._topics = bag.topics()
        self._episodes = episode_headers(bag)
        wanted = {STATE_TOPIC, OUTCOME_TOPIC}
        images: set[str] = set()
        for episode in self._episodes:
            wanted |= {one["topic"] for one in episode["topics"]}
            for key, feature in episode["features"].items():
                if feature["dtype"] in ("string", "language") and key != keys.SUBTASK:
                    wanted.add(own_topic(key))
                elif feature["dtype"] == "video":
                    images.add(self._image_topic(key))
        self._messages = bag.read(wanted, images)
        self._stamps: dict[str, NDArray[np.int64]] = {}
        self._values: dict[str, NDArray[Any]] = {}
        self._pictures: dict[str, Picker] = {}
        self._state = self._table(STATE_TOPIC, types.STATE, STATE_COLUMNS, "control.")
        self._outcome = self._table(OUTCOME_TOPIC, types.OUTCOME, OUTCOME_COLUMNS, "next.", "subtask")

    def all(self) -> Iterator[dict[str, Any]]:
        """Yield what is said of each episode, in order."""
        yield from self._episodes

    def save(self, episode: Mapping[str, Any], recorder: DatasetRecorder) -> int:
        """Save an episode and return its number of frames."""
        rows = self._rows(self._state, episode, STATE_TOPIC)
        observed = _time(self._state, "observed")[rows]
        ended = _time(self._state, "header.stamp")[rows]
        columns: dict[str, NDArray[Any]] = {}
        features = episode["features"]
        for key in STATE_COLUMNS:
            if key in features:
                columns[key] = _typed(self._state[key][rows], features[key])
        outcome_rows = self._rows(self._outcome, episode, OUTCOME_TOPIC)
        for key in (*OUTCOME_COLUMNS, keys.SUBTASK):
            if key in features:
                columns[key] = _typed(self._outcome[key][outcome_rows], features[key])
        for key, feature in features.items():
            parts = [one for one in episode["topics"] if one["feature"] == key]
            if parts:
                at = ended if key == keys.APPLIED_ACTION else observed
                columns[key] = self._vector(feature, parts, at)
            elif feature["dtype"] in ("string", "language") and key != keys.SUBTASK:
                columns[key] = self._texts(key, observed)
        changed = [key for key, values in columns.items() if checksum.of_column(values) != episode["checksums"][key]]
        if changed:
            raise DatasetError(
                f"{self._bag.path}: {changed[0]} of episode {episode['episode_index']} is not what was exported: its "
                f"checksum is wrong, so the bag is damaged or was changed. {REMEDY}"
            )
        writer = recorder.begin_episode()
        try:
            writer.set_columns(columns)
            for key, feature in features.items():
                if feature["dtype"] == "video":
                    topic = self._image_topic(key)
                    places = self._places(topic, self._head_stamps(topic), observed)
                    pictures = self._pictures.setdefault(topic, Picker(self._bag, topic))
                    for place in self._messages[topic].order[places].tolist():
                        image = decode_image(topic, self._topics[topic].msgtype, pictures.get(place))
                        writer.add_image(key, image)
            recorder.save(writer, task=episode["task"], metadata=episode["metadata"])
        except BaseException:
            writer.discard()
            raise
        return len(observed)

    # --- where a frame's messages are --------------------------------------------------------------------------------

    def _table(self, topic: str, msgtype: str, columns: Sequence[str], prefix: str, *more: str) -> dict[str, Any]:
        paths = [key.removeprefix(prefix) for key in columns]
        fixed = ["episode_index", "frame_index", "header.stamp.sec", "header.stamp.nanosec", *more]
        fixed += ["observed.sec", "observed.nanosec"] if msgtype == types.STATE else []
        found = decode(msgtype, self._messages[topic].data, [*paths, *fixed])
        return found | {key: found[path] for key, path in zip(columns, paths, strict=True)}

    def _rows(self, table: Mapping[str, Any], episode: Mapping[str, Any], topic: str) -> NDArray[np.intp]:
        """Return which messages are those of the episode's frames, in order."""
        stamps = _time(table, "header.stamp")
        mask = (table["episode_index"] == episode["episode_index"]) & (stamps >= episode["start"])
        mask &= stamps < episode["next_start"]
        rows = np.flatnonzero(mask)
        rows = rows[np.argsort(table["frame_index"][rows], kind="stable")]
        n = episode["frames"]
        if not np.array_equal(table["frame_index"][rows], np.arange(n)):
            raise self._incomplete(topic, n - len(np.intersect1d(table["frame_index"][rows], np.arange(n))), n)
        return rows

    def _incomplete(self, topic: str, missing: int, frames: int) -> DatasetError:
        damage = f" ({'; '.join(self._bag.problems)})" if self._bag.problems else ""
        return DatasetError(
            f"{self._bag.path} was written by bhd-data export, but {topic} lacks {missing} of {frames} messages of an "
            f"episode{damage}. {REMEDY}"
        )

    def _places(
        self, topic: str, stamps: NDArray[np.int64], wanted: NDArray[np.int64], *, held: bool = False
    ) -> NDArray[np.intp]:
        """Return the message of each stamp, or, if `held`, the newest one until then."""
        order = np.argsort(stamps, kind="stable")
        ordered = stamps[order]
        place = np.searchsorted(ordered, wanted, side="right") - 1
        known = ordered[np.maximum(place, 0)] if len(ordered) else np.zeros_like(wanted)
        # what is held never comes from the episode before, which ended seconds ago
        bad = (place < 0) | ((known != wanted) if not held else (known < wanted[0] - NANO))
        if bad.any():
            raise self._incomplete(topic, int(bad.sum()), len(wanted))
        return order[place]

    # --- what is in them ---------------------------------------------------------------------------------------------

    def _vector(
        self, feature: Mapping[str, Any], topics: Sequence[Mapping[str, Any]], at: NDArray[np.int64]
    ) -> NDArray[Any]:
        size = int(feature["shape"][0])
        names = feature.get("names")
        place = {str(name): column for column, name in enumerate(names)} if isinstance(names, list) else {}
        result = np.zeros((len(at), size), feature["dtype"])
        for one in topics:
            part = PARTS[one["kind"]](one["topic"], tuple(one["names"]))
            rows = self._places(part.topic, self._part_stamps(part), at, held=isinstance(part, ScanPart))
            values = self._part_values(part, rows)
            whole = len(topics) == 1 and len(part) == size
            result[:, range(size) if whole and not place else [place[name] for name in part.names]] = values
        return result[:, 0] if size == 1 else result

    def _part_stamps(self, part: Part) -> NDArray[np.int64]:
        if part.topic not in self._stamps:
            messages = self._messages[part.topic]
            bare = isinstance(part, BareTwistPart)
            self._stamps[part.topic] = messages.received if bare else header_stamps(part.msgtype, messages.data)
        return self._stamps[part.topic]

    def _head_stamps(self, topic: str) -> NDArray[np.int64]:
        if topic not in self._stamps:
            self._stamps[topic] = head_stamps(topic, self._messages[topic].data)
        return self._stamps[topic]

    def _part_values(self, part: Part, rows: NDArray[np.intp]) -> NDArray[Any]:
        messages = self._messages[part.topic].data
        if isinstance(part, OdometryPart):  # its yaw is unwrapped, and another episode's turns are not this one's
            return part.decode([messages[row] for row in rows])
        if part.topic not in self._values:
            self._values[part.topic] = part.decode(messages)
        return self._values[part.topic][rows]

    def _texts(self, key: str, at: NDArray[np.int64]) -> NDArray[Any]:
        topic = own_topic(key)
        if topic not in self._values:
            self._values[topic] = decode(types.TEXT, self._messages[topic].data, ("text",))["text"]
        texts = self._values[topic]
        rows = self._places(topic, self._head_stamps(topic), at, held=True)
        values = np.empty(len(at), object)
        values[:] = [json.loads(texts[row]) if key == LANGUAGE else texts[row] for row in rows]
        return values

    def _image_topic(self, key: str) -> str:
        for compressed, msgtype in ((False, IMAGE), (True, COMPRESSED)):
            topic = image_topic(key, compressed=compressed)
            if topic in self._topics and self._topics[topic].msgtype == msgtype:
                return topic
        raise DatasetError(
            f"{self._bag.path} has no pictures for {key}: {image_topic(key, compressed=False)} is missing. {REMEDY}"
        )


def _time(table: Mapping[str, Any], path: str) -> NDArray[np.int64]:
    return table[f"{path}.sec"].astype(np.int64) * NANO + table[f"{path}.nanosec"]


def _typed(values: NDArray[Any], feature: Mapping[str, Any]) -> NDArray[Any]:
    return values if feature["dtype"] == "string" else values.astype(feature["dtype"])


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 100 else f"{text[:100]} …"
