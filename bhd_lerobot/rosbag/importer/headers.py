"""What bags of `bag_export` say of their episodes."""

import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from bhd_lerobot.errors import DatasetError
from bhd_lerobot.rosbag.exporter.episode import EPISODE_TOPIC
from bhd_lerobot.rosbag.messages import types
from bhd_lerobot.rosbag.messages.cdr_read import decode
from bhd_lerobot.rosbag.messages.parts import NANO
from bhd_lerobot.rosbag.storage import checksum
from bhd_lerobot.rosbag.storage.read import Bag, Topic

REMEDY = "Export it again, or import it as a bag of a real robot, with --resample."


def is_ours(topics: Mapping[str, Topic]) -> bool:
    """Return whether a bag holds episodes that `bag_export` wrote."""
    topic = topics.get(EPISODE_TOPIC)
    return topic is not None and topic.msgtype == types.EPISODE and topic.count > 0


def episode_headers(bag: Bag) -> list[dict[str, Any]]:
    """Return what is said of each episode of a bag, in the order of time.

    Raises:
        DatasetError: it is damaged, or of another version.
    """
    messages = bag.read([EPISODE_TOPIC])[EPISODE_TOPIC].data
    if not messages:
        raise DatasetError(
            f"{bag.path}: no message of {EPISODE_TOPIC} can be read. {'; '.join(bag.problems)}. {REMEDY}"
        )
    plain = ("robot_type", "fps", "episode_index", "frames", "task", "format", "checksum", "stamp.sec", "stamp.nanosec")
    structured = ("features", "metadata", "metadata_types", "recording", "video", "topics", "checksums")
    episodes = []
    for message in messages:
        found = {path: values[0] for path, values in decode(types.EPISODE, [message], (*plain, *structured)).items()}
        if found["format"] != types.FORMAT:
            raise DatasetError(
                f"{bag.path} was written with version {found['format']} of our messages; this program reads version "
                f"{types.FORMAT}. Use the version of bhd_lerobot that wrote it."
            )
        if checksum.of_texts(found) != found["checksum"]:
            raise DatasetError(f"{bag.path}: a message of {EPISODE_TOPIC} is damaged: its checksum is wrong. {REMEDY}")
        try:
            found |= {key: json.loads(found[key]) for key in structured}
        except ValueError as error:
            raise DatasetError(f"{bag.path}: what {EPISODE_TOPIC} says is no JSON: {error}.") from error
        found |= {key: int(found[key]) for key in ("fps", "episode_index", "frames")}
        found["metadata"] = _complete(found["metadata"], found["metadata_types"])
        missing = [
            key for key, one in found["features"].items() if one["dtype"] != "video" and key not in found["checksums"]
        ]
        if missing:
            raise DatasetError(f"{bag.path}: {EPISODE_TOPIC} has no checksum of {missing[0]}. {REMEDY}")
        episodes.append({**found, "start": int(found["stamp.sec"]) * NANO + int(found["stamp.nanosec"])})
    episodes.sort(key=lambda episode: episode["start"])
    starts = [episode["start"] for episode in episodes[1:]] + [np.iinfo(np.int64).max]
    return [{**episode, "next_start": start} for episode, start in zip(episodes, starts, strict=True)]


def _complete(metadata: Mapping[str, Any], kinds: Mapping[str, str]) -> dict[str, Any]:
    """Return metadata in which no value is missing: an edit may leave some out, the recorder wants them all."""
    nothing = {"string": "", "bool": False, "int64": 0, "double": float("nan")}
    return {
        key: nothing.get(kinds.get(key, ""), []) if value is None else value
        for key, value in {**dict.fromkeys(kinds), **metadata}.items()
    }
