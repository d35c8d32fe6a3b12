"""The description in a bag of `bhd-data export`: robot, rate, features, episodes. Its import needs no option."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any

from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.errors import DatasetError, DatasetMismatchError
from bhd_lerobot.ros2.bag.exporter.episode import EPISODE_TOPIC, image_topic
from bhd_lerobot.ros2.bag.importer.sources import Source, exported_sources
from bhd_lerobot.ros2.bag.storage.read import Bag
from bhd_lerobot.ros2.messages import types
from bhd_lerobot.ros2.messages.parts import NANO, Part
from bhd_lerobot.ros2.messages.serialize import decode
from bhd_lerobot.ros2.messages.split import PARTS

_REMEDY = "Export the dataset again, or import a TurtleBot3's bag as a real robot's with --robot=turtlebot3."
_VECTORS = (keys.OBSERVATION_STATE, keys.ENVIRONMENT_STATE, keys.ACTION)
_MOST_FPS = 10_000  # more is damage, and would be frames without end
_SAME = ("robot_type", "fps", "features", "metadata_types")


@dataclass(frozen=True)
class ExportedEpisode:
    """An episode as its bag describes it.

    Attributes:
        place: of its description among all messages of the bag; those of the episode come after it.
        start: the first frame [ns]: by the reception of its description, and by its stamp.
        frames: how many it has.
        duration: of all of them [ns].
        robot_type, fps, features: of its dataset.
        task: the instruction.
        metadata: of the episode in the dataset, without the prefix ``bhd/``; the same keys in all episodes.
        metadata_types: names of their types.
        parts: what carries a feature's numbers.
    """

    place: int
    start: tuple[int, int]
    frames: int
    duration: int
    robot_type: str
    fps: int
    features: Mapping[str, Any]
    task: str
    metadata: Mapping[str, Any]
    metadata_types: Mapping[str, str]
    parts: Mapping[str, Sequence[Part]]


def is_exported(bag: Bag) -> bool:
    """Return whether a bag holds episodes that `bhd-data export` wrote."""
    topic = bag.topics.get(EPISODE_TOPIC)
    return topic is not None and topic.msgtype == types.EPISODE and topic.count > 0


def exported_episodes(bags: Sequence[Bag]) -> list[list[ExportedEpisode]]:
    """Return the episodes of each bag, in the order in which they were written.

    Raises:
        DatasetError: a description is damaged, or of another version.
        DatasetMismatchError: they are of different datasets.
    """
    episodes = [_episodes(bag) for bag in bags]
    first = episodes[0][0]
    for bag, found in zip(bags, episodes, strict=True):
        for episode in found:
            for name in _SAME:
                if getattr(episode, name) != getattr(first, name):
                    raise DatasetMismatchError(
                        f"{bag.path} holds an episode whose {name} differs from that of the first one: "
                        f"{_short(getattr(episode, name))} instead of {_short(getattr(first, name))}. Import bags of "
                        "one dataset at a time."
                    )
    return episodes


def _episodes(bag: Bag) -> list[ExportedEpisode]:
    try:
        # A bag of one episode begins with its description, and is not read to its end here.
        messages = islice(bag.messages((EPISODE_TOPIC,)), bag.topics[EPISODE_TOPIC].count)
        episodes = [_episode(payload, received, place) for _, received, place, payload in messages]
    except (DatasetError, LookupError, TypeError, ValueError, ArithmeticError, AttributeError) as error:
        raise DatasetError(
            f"{bag.path}: {EPISODE_TOPIC} cannot be read as version {types.FORMAT} of our messages ({error}). It is "
            f"damaged, or another version of bhd_lerobot wrote it. {_REMEDY}"
        ) from error
    if not episodes:
        raise DatasetError(
            f"{bag.path}: no message of {EPISODE_TOPIC} can be read. {'; '.join(bag.problems)}. {_REMEDY}"
        )
    return episodes


def _episode(message: bytes, received: int, place: int) -> ExportedEpisode:
    found = decode(types.EPISODE, message)
    if found.format != types.FORMAT:
        raise ValueError(f"it is of version {found.format}")
    features, metadata = json.loads(found.features), json.loads(found.metadata)
    kinds, topics = json.loads(found.metadata_types), json.loads(found.topics)
    parts: dict[str, list[Part]] = {}
    for topic in topics:
        part = PARTS[topic["kind"]](topic["topic"], tuple(topic["names"]))
        parts.setdefault(topic["feature"], []).append(part)
    if not 1 <= found.fps <= _MOST_FPS:
        raise ValueError(f"it has {found.fps} frames a second")
    episode = ExportedEpisode(
        place=place,
        start=(received, found.stamp.sec * NANO + found.stamp.nanosec),
        frames=found.frames,
        duration=found.frames * NANO // found.fps,
        robot_type=found.robot_type,
        fps=found.fps,
        features={str(key): {**feature} for key, feature in features.items()},
        task=found.task,
        metadata=_complete(metadata, kinds),
        metadata_types=kinds,
        parts=parts,
    )
    for key in _VECTORS:
        if sorted(names_of(episode, key)) != sorted(name for part in parts.get(key, ()) for name in part.names):
            raise ValueError(f"its topics do not carry the numbers of {key}")
    return episode


def names_of(episode: ExportedEpisode, key: str) -> tuple[str, ...]:
    """Return the names of a vector's numbers, in order; nothing if there is no such vector."""
    feature = episode.features.get(key)
    return () if feature is None else keys.numbered_names_of(feature)


def sources_of(episode: ExportedEpisode, bag: Bag) -> list[Source]:
    """Return what is read of an exported bag.

    Raises:
        DatasetError: the bag has no observations.
    """
    if keys.OBSERVATION_STATE not in episode.parts:
        raise DatasetError(f"{EPISODE_TOPIC} names no {keys.OBSERVATION_STATE}, so there is nothing to import.")
    parts = {key: episode.parts[key] for key in _VECTORS if key in episode.parts}
    return exported_sources(parts, _cameras(episode, bag))


def _cameras(episode: ExportedEpisode, bag: Bag) -> dict[str, str]:
    """Return the topics of an episode's cameras by name; raw images if a bag has both."""
    return {
        key.removeprefix(f"{keys.OBSERVATION_IMAGES}."): next(
            (topic for packed in (False, True) if (topic := image_topic(key, compressed=packed)) in bag.topics),
            image_topic(key, compressed=False),
        )
        for key, feature in episode.features.items()
        if feature.get("dtype") == "video"
    }


def _complete(metadata: Mapping[str, Any], kinds: Mapping[str, str]) -> dict[str, Any]:
    """Return metadata in which no value is missing: an edit may leave some out, the recorder wants them all."""
    nothing = {"string": "", "bool": False, "int64": 0, "double": float("nan")}
    return {
        key: nothing.get(kinds.get(key, ""), []) if value is None else value
        for key, value in {**dict.fromkeys(kinds), **metadata}.items()
    }


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 100 else f"{text[:100]} …"
