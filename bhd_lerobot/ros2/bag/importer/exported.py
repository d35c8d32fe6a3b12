"""What a bag that `bhd-data export` wrote states of its dataset and of each episode: what no other topic carries."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.registry import body_of
from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.errors import DatasetError
from bhd_lerobot.ros2.bag.importer.resample import NANO, Times
from bhd_lerobot.ros2.bag.storage.read import Bag, Messages, Topic
from bhd_lerobot.ros2.messages import presets, types
from bhd_lerobot.ros2.messages.mapping import (
    FieldConfig,
    ImageConfig,
    MappingConfig,
    TopicFields,
    features_of,
    topics_of,
)
from bhd_lerobot.ros2.messages.parts import camera_name, image_topic
from bhd_lerobot.ros2.messages.scan import static_topics
from bhd_lerobot.ros2.messages.serialize import decode
from bhd_lerobot.ros2.messages.table import SCAN
from bhd_lerobot.tasks.task import Event

_TOPICS = (types.EPISODE_TOPIC, types.STATE_TOPIC, types.OUTCOME_TOPIC)


@dataclass(frozen=True)
class StatedEpisode:
    """What an exported bag states of an episode.

    Attributes:
        received, stamp: when it starts, by the recorder's clock and by the headers' [ns].
        outcome: None if its dataset has none.
        times: of its frames [ns]; none if some are not in the bag, or the bag was recorded anew while it was played.
        columns: of its frames, beside observation and action.
    """

    received: int
    stamp: int
    task: str
    outcome: str | None
    times: Times
    columns: dict[str, NDArray[Any]]


@dataclass(frozen=True)
class Exported:
    """What an exported bag states.

    Attributes:
        mapping: None if the bag of its robot cannot be read by one.
        messages: of the topics that the mapping names, and of the transforms, read in the same pass.
    """

    robot_type: str
    fps: int
    mapping: MappingConfig | None
    episodes: Sequence[StatedEpisode]
    messages: Mapping[str, Messages]

    def at(self, time: int, *, by_header: bool) -> StatedEpisode:
        """Return the episode that a time [ns] lies in."""
        later = [one for one in self.episodes if (one.stamp if by_header else one.received) <= time]
        return later[-1] if later else self.episodes[0]


@lru_cache(maxsize=1)
def exported(bag: Bag) -> Exported | None:
    """Return what a bag states; None of any other, and of one whose statement is damaged. It is read once."""
    if types.EPISODE_TOPIC not in bag.topics or bag.topics[types.EPISODE_TOPIC].msgtype != types.EPISODE:
        return None
    kinds = dict(zip(_TOPICS, (types.EPISODE, types.STATE, types.OUTCOME), strict=True))
    try:
        _, _, _, data = next(bag.messages([types.EPISODE_TOPIC]))
        first = decode(types.EPISODE, data)
        applied, mapping = topics_of(_section(bag.topics, first, keys.APPLIED_ACTION), {}), _mapping(bag.topics, first)
        numbers = {*static_topics("")} & bag.topics.keys()
        images: set[str] = set()
        if mapping is not None:
            numbers |= {one.topic for one in (*mapping.observation.values(), *mapping.action.values())}
            images = {one.topic for one in mapping.images.values()}
        found = bag.read({*kinds, *numbers, *(one.topic for one in applied)}, images)
        heads, *frames = [[decode(kinds[topic], data) for data in found[topic].data] for topic in kinds]
        received = found[types.EPISODE_TOPIC].received.tolist()
        states, outcomes = map(_by_episode, frames)
        episodes = [
            _episode(head, time, states.get(head.episode_index, []), outcomes.get(head.episode_index, []))
            for head, time in zip(heads, received, strict=True)
        ]
        for episode, values in zip(episodes, _applied(found, applied, heads), strict=False):
            episode.columns[keys.APPLIED_ACTION] = values
        messages = {name: found[name] for name in numbers | images}
        return Exported(first.robot_type, first.fps, mapping, episodes, messages)
    except (DatasetError, IndexError, KeyError, StopIteration, TypeError, ValueError):
        return None  # damaged; import names what it lacks


def _by_episode(messages: Sequence[Any]) -> dict[int, list[Any]]:
    found: dict[int, list[Any]] = {}
    for one in messages:
        found.setdefault(one.episode_index, []).append(one)
    return found


def _episode(head: Any, received: int, states: Sequence[Any], outcomes: Sequence[Any]) -> StatedEpisode:
    metadata, features = json.loads(head.metadata), json.loads(head.features)
    # Of a dataset with outcomes each episode has one; those of other programs may have other names.
    named = metadata["outcome"] or "nothing" if "outcome" in metadata else ""
    outcome = Event[named.upper()].cause if named.upper() in Event.__members__ else None
    columns = {
        key: np.array([getattr(one, key.rpartition(".")[2]) for one in messages]).astype(keys.SCALARS[key][0])
        for names, messages in ((types.STATE_COLUMNS, states), (types.OUTCOME_COLUMNS, outcomes))
        for key in names
        if key in features
    }
    stamp = _nanoseconds(head.stamp)
    is_whole = len(states) == len(outcomes) == head.frames and received == stamp
    times = [_nanoseconds(one.observed) for one in states if is_whole]
    return StatedEpisode(received, stamp, head.task, outcome, np.array(times, np.int64), columns)


def _nanoseconds(stamp: Any) -> int:
    return int(stamp.sec * NANO + stamp.nanosec)


def _applied(
    found: Mapping[str, Messages], topics: Sequence[TopicFields], heads: Sequence[Any]
) -> list[NDArray[np.float32]]:
    """Return what was applied in the frames of each episode; nothing if messages are missing."""
    ends = np.cumsum([head.frames for head in heads])
    values = np.zeros((ends[-1], sum(len(one.columns) for one in topics)), np.float32)
    for one in topics:
        messages = found[one.topic].data
        if len(messages) != len(values):
            return []
        values[:, one.columns] = [one.read(decode(one.msgtype, data)) for data in messages]
    return np.split(values, ends[:-1]) if topics else []


def _mapping(topics: Mapping[str, Topic], head: Any) -> MappingConfig | None:
    observation, action = (_section(topics, head, key) for key in (keys.OBSERVATION_STATE, keys.ACTION))
    images = {}
    for key, feature in json.loads(head.features).items():
        for topic in (image_topic(key, compressed=compressed) for compressed in (False, True)):
            name = key.removeprefix(f"{keys.OBSERVATION_IMAGES}.")
            if feature["dtype"] == "video" and topic in topics:
                images[name if name.isidentifier() else camera_name(key)] = ImageConfig(
                    topic, type=topics[topic].msgtype
                )
    return MappingConfig(observation, action, images) if observation and action else None


def _section(topics: Mapping[str, Topic], head: Any, key: str) -> dict[str, FieldConfig]:
    """Return where the numbers of a feature are, in its order; nothing if there are none, or they are whole numbers."""
    features = json.loads(head.features)
    if features.get(key, {}).get("dtype") not in ("float32", "float64"):
        return {}
    entries: dict[str, FieldConfig] = {}
    for part in json.loads(head.topics):
        if part["feature"] == key:
            entries |= _entries(topics[part["topic"]], part["names"], head.robot_type)
    names = keys.numbered_names_of(features[key])
    in_order = dict(sorted(entries.items(), key=lambda entry: names.index(entry[1].names(entry[0])[0])))
    return in_order if features_of(in_order) == names else {}


def _entries(topic: Topic, names: Sequence[str], robot_type: str) -> dict[str, FieldConfig]:
    if topic.msgtype == types.NUMBERS:
        return {name: FieldConfig(topic.name, types.NUMBERS, f"values[names={name}]") for name in names}
    if topic.msgtype != SCAN:
        return presets.entries(topic.name, topic.msgtype, names)
    lidar = getattr(body_of(robot_type), "lidar", None)
    if lidar is None:
        return {}
    ranges = {"range_min": lidar.range_min, "range_max": lidar.range_max}
    return {"scan": FieldConfig(topic.name, SCAN, "ranges", beams=len(names), **ranges)}
