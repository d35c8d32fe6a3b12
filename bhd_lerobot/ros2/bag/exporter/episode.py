"""An episode of a dataset as topics of a bag: its description, its columns, and topics for viewers."""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pyarrow import types as arrow

from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.datasets.format.columns import video_frames
from bhd_lerobot.datasets.format.episode_table import PREFIX
from bhd_lerobot.datasets.format.schema import DEFAULT_FEATURES, LANGUAGE
from bhd_lerobot.datasets.format.state import DatasetState, Row, slot_of
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.errors import DatasetError, UnsupportedDatasetError
from bhd_lerobot.ros2.bag.storage.write import Stream
from bhd_lerobot.ros2.messages import types, views
from bhd_lerobot.ros2.messages.base import OdometryPart, ScanPart
from bhd_lerobot.ros2.messages.images import COMPRESSED, IMAGE, encode_image
from bhd_lerobot.ros2.messages.parts import (
    NANO,
    Frames,
    IntegersPart,
    NumbersPart,
    Part,
    camera_name,
    image_topic,
    own_topic,
    stamp_tree,
)
from bhd_lerobot.ros2.messages.serialize import encode
from bhd_lerobot.ros2.messages.split import check_topics, parts_of
from bhd_lerobot.ros2.messages.table import JOINTS

_PLAIN = (arrow.is_string, arrow.is_boolean, arrow.is_integer, arrow.is_floating, arrow.is_list, arrow.is_null)
_LONGEST_S = 1e8  # three years, longer than any recording
_PAUSE_NS = 10 * NANO  # between two episodes
_APART_NS = 2000  # of two frames at least; an import takes times within a microsecond for the same
START_S = 1_000_000_000  # [s] since 1970: a dataset does not know on which day it was recorded


@dataclass(frozen=True)
class ExportOptions:
    """How bags are written.

    Attributes:
        one_bag: all episodes in one bag, instead of a bag for each.
        start_s: when the first episode starts [s since 1970].
    """

    storage: str = "mcap"
    episodes: Sequence[int] | None = None
    one_bag: bool = False
    bare_twist: bool = False
    compressed_images: bool = False
    start_s: float = START_S


class EpisodeTopics:
    """Makes the topics of a dataset's episodes; the clock continues from one to the next."""

    def __init__(self, state: DatasetState, view: views.RobotView, repo_id: str, options: ExportOptions) -> None:
        self._state, self._view, self._repo_id, self._options = state, view, repo_id, options
        self._features: dict[str, Any] = {k: v for k, v in state.info["features"].items() if k not in DEFAULT_FEATURES}
        self._robot = str(state.info.get("robot_type") or "")
        self._next_start = round(options.start_s * NANO)
        if state.info["fps"] % 1:
            raise UnsupportedDatasetError(
                f"{state.root} has {state.info['fps']} frames a second; bags state a whole number of them."
            )
        for name, kind in state.metadata_types.items():
            if not any(is_one(kind) for is_one in _PLAIN):
                raise UnsupportedDatasetError(
                    f"{PREFIX}{name} of the episodes of {state.root} is {kind}; bags hold texts, numbers, truth values "
                    "and lists of them."
                )
        self._parts = {key: self._parts_of(key) for key in self._features}
        check_topics([*(part.topic for parts in self._parts.values() for part in parts), *self._other_topics()])
        self.custom = {"bhd_format": str(types.FORMAT), "bhd_repo_id": repo_id, "bhd_robot_type": self._robot}

    def _other_topics(self) -> Iterator[str]:
        """Yield the topics of texts and of cameras, and those that every episode has."""
        yield from (types.EPISODE_TOPIC, types.STATE_TOPIC, types.OUTCOME_TOPIC)
        for key, feature in self._features.items():
            if feature["dtype"] == "video":
                yield image_topic(key, compressed=self._options.compressed_images)
            elif feature["dtype"] in ("string", "language") and key != keys.SUBTASK:
                yield own_topic(key)

    def _parts_of(self, key: str) -> list[Part]:
        feature = self._features[key]
        kind, shape = feature["dtype"], tuple(feature["shape"])
        if key in (*types.STATE_COLUMNS, *types.OUTCOME_COLUMNS, keys.SUBTASK) and shape == (1,):
            return []
        if kind in ("string", "language") or (kind == "video" and 3 in (shape[0], shape[-1])):
            return []
        if len(shape) != 1 or kind not in ("float32", "float64", "int64", "bool"):
            raise UnsupportedDatasetError(
                f"Feature {key!r} of {self._state.root} is of type {kind}, shape {shape}; bags are made of vectors of "
                "float32, float64, int64 and bool, of texts and of video in colour."
            )
        names = keys.numbered_names_of(feature)
        if kind in ("int64", "bool"):
            return [IntegersPart(own_topic(key), names)]
        if kind == "float64":
            return [NumbersPart(own_topic(key), names)]
        return parts_of(
            key, names, self._robot,
            lidar=self._view.lidar, noise=self._view.noise, bare_twist=self._options.bare_twist,
        )  # fmt: skip

    def streams(self, row: Row, columns: Mapping[str, NDArray[Any]]) -> list[Stream]:
        """Return the topics of an episode. At the same time, observations come before actions."""
        start, n, episode = self._next_start, row["length"], row["episode_index"]
        self._check_times(episode, columns)
        seconds = columns.get(keys.TIME, np.arange(n) / self._state.info["fps"])
        observed = _rising(start + np.round(np.asarray(seconds, np.float64) * NANO).astype(np.int64))
        ended = np.append(observed[1:], observed[-1:] + round(NANO / self._state.info["fps"]))
        self._next_start = int(ended[-1]) + _PAUSE_NS
        index = np.arange(n)
        at_start, at_end = Frames(episode, index, observed), Frames(episode, index, ended)
        streams = [Stream(types.EPISODE_TOPIC, types.EPISODE, [(start, self._episode(row, start))], latched=True)]
        motion = views.Motion.of(self._view, self._features, columns)
        if still := views.static_transforms(views.still_frames(self._view, motion), start):
            streams.append(Stream("/tf_static", views.TF, [(start, still[0])], latched=True))
        for key, parts in self._parts.items():
            frames = at_end if key == keys.APPLIED_ACTION else at_start
            for part, values in _split(self._features[key], parts, columns.get(key)):
                if isinstance(part, ScanPart):
                    streams.append(scan_stream(part, at_start, values, columns.get(keys.AGE)))
                else:
                    streams.append(_stream(part.topic, part.msgtype, frames, part.encode(frames, values)))
                if isinstance(part, OdometryPart):
                    moved = views.base_transforms(part, frames, values)
                    streams.append(_stream("/tf", views.TF, frames, moved))
            if key == keys.OBSERVATION_STATE:
                streams += self._viewer_streams(at_start, columns, motion)
        for key, feature in self._features.items():
            if feature["dtype"] == "video":
                streams += self._video(key, row, at_start)
            elif feature["dtype"] in ("string", "language") and key != keys.SUBTASK:
                streams.append(_texts(key, at_start, columns[key]))
        streams.append(_stream(types.STATE_TOPIC, types.STATE, at_end, _states(at_end, observed, columns)))
        streams.append(_stream(types.OUTCOME_TOPIC, types.OUTCOME, at_end, _outcomes(at_end, columns)))
        return streams

    def _check_times(self, episode: int, columns: Mapping[str, NDArray[Any]]) -> None:
        for key in (keys.TIME, keys.AGE):
            wrong = np.flatnonzero(~(np.abs(columns.get(key, np.zeros(0))) <= _LONGEST_S))
            if len(wrong):
                raise DatasetError(
                    f"{key} of episode {episode} of {self._state.root} is {columns[key][wrong[0]]} in frame "
                    f"{wrong[0]}, so its messages have no time. Leave the episode out (--episodes)."
                )

    def _viewer_streams(
        self, frames: Frames, columns: Mapping[str, NDArray[Any]], motion: views.Motion
    ) -> list[Stream]:
        streams = []
        if wheels := views.wheel_states(self._view, frames, self._features, columns):
            streams.append(_stream("/joint_states", JOINTS, frames, wheels))
        if links := views.moving_transforms(self._view, frames, motion):
            streams.append(_stream("/tf", views.TF, frames, links))
        return streams

    def _video(self, key: str, row: Row, frames: Frames) -> list[Stream]:
        camera, compressed = camera_name(key), self._options.compressed_images
        optical = f"{camera}_optical_frame"
        path = self._state.root / layout.video_file(key, slot_of(row, f"videos/{key}"))
        images = video_frames(path, row[f"videos/{key}/from_timestamp"], row["length"])
        topic = image_topic(key, compressed=compressed)

        def messages() -> Iterator[tuple[int, bytes]]:
            for number, image in enumerate(images):
                message = encode_image(frames.at(number), optical, image, compressed=compressed)
                yield int(frames.stamps[number]), message

        streams = [Stream(topic, COMPRESSED if compressed else IMAGE, messages())]
        if fovy := self._view.fovy.get(camera):
            size = (int(self._features[key]["shape"][0]), int(self._features[key]["shape"][1]))
            geometry = views.camera_info(frames, optical, size, fovy)
            streams.append(_stream(f"/{camera}/camera_info", views.CAMERA_INFO, frames, geometry))
        return streams

    def _episode(self, row: Row, start: int) -> bytes:
        identity = self._state.identity or {}
        metadata = {name.removeprefix(PREFIX): value for name, value in row.items() if name.startswith(PREFIX)}
        topics = [
            {"feature": key, "topic": part.topic, "kind": part.kind, "names": list(part.names)}
            for key, parts in self._parts.items()
            for part in parts
        ]
        fields: dict[str, Any] = {
            "stamp": stamp_tree(np.array([start])),
            "format": types.FORMAT,
            "repo_id": self._repo_id,
            "robot_type": self._robot,
            "fps": int(self._state.info["fps"]),
            "episode_index": row["episode_index"],
            "frames": row["length"],
            "task": row["tasks"][0] if row["tasks"] else "",
            "features": json.dumps(self._features),
            "metadata": json.dumps(metadata),
            "metadata_types": json.dumps({name: str(kind) for name, kind in self._state.metadata_types.items()}),
            "recording": json.dumps(identity.get("recording", {})),
            "topics": json.dumps(topics),
        }
        return encode(types.EPISODE, fields, 1)[0]


def _split(
    feature: Mapping[str, Any], parts: Sequence[Part], values: NDArray[Any] | None
) -> Iterator[tuple[Part, NDArray[Any]]]:
    """Yield the numbers of each part, shape (n, len(part.names)), as float64 or as integers."""
    if not parts or values is None:
        return
    table = values.reshape(len(values), -1)
    table = table.astype(np.int64 if isinstance(parts[0], IntegersPart) else np.float64)
    names = keys.numbered_names_of(feature)
    if len(parts) == 1 and parts[0].names == names:
        yield parts[0], table
        return
    place = {name: column for column, name in enumerate(names)}
    for part in parts:
        yield part, table[:, [place[name] for name in part.names]]


def _rising(stamps: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return stamps of which each is later than the one before, by more than what an import takes for the same time."""
    steps = _APART_NS * np.arange(len(stamps))
    return np.maximum.accumulate(stamps - steps) + steps


def _stream(topic: str, msgtype: str, frames: Frames, messages: Sequence[bytes]) -> Stream:
    return Stream(topic, msgtype, zip(frames.stamps.tolist(), messages, strict=True))


def scan_stream(part: ScanPart, frames: Frames, values: NDArray[Any], age: NDArray[Any] | None) -> Stream:
    """Return each scan once, stamped when it was measured and received with the first frame that has it.

    A scan that was seen in one frame and not in the one before was measured after that one: the age, which on the wall
    clock includes the way to the brain, never moves it further back.
    """
    assert part.lidar is not None
    stamps = frames.stamps
    measured = stamps if age is None else stamps - np.round(age.astype(np.float64) * NANO).astype(np.int64)
    moved = np.diff(measured, prepend=measured[:1] - NANO) > NANO / part.lidar.rate_hz / 2
    new = moved | np.append(True, (values[1:] != values[:-1]).any(axis=1))
    new[0] = True
    measured = np.maximum(measured, np.append(measured[:1], stamps[:-1] + 1))[new]
    scans = Frames(frames.episode, frames.index[new], measured)
    return Stream(part.topic, part.msgtype, zip(stamps[new].tolist(), part.encode(scans, values[new]), strict=True))


def _states(frames: Frames, observed: NDArray[np.int64], columns: Mapping[str, NDArray[Any]]) -> list[bytes]:
    fields = {**frames.fields(), "observed": stamp_tree(observed)}
    fields |= {key.removeprefix("control."): columns[key] for key in types.STATE_COLUMNS if key in columns}
    return encode(types.STATE, fields, len(observed))


def _outcomes(frames: Frames, columns: Mapping[str, NDArray[Any]]) -> list[bytes]:
    fields = {**frames.fields(), "subtask": columns.get(keys.SUBTASK, "")}
    fields |= {key.removeprefix("next."): columns[key] for key in types.OUTCOME_COLUMNS if key in columns}
    return encode(types.OUTCOME, fields, len(frames.stamps))


def _texts(key: str, frames: Frames, values: NDArray[Any]) -> Stream:
    """Return a text when it changes; what is not text is written as JSON."""
    messages, before = [], None
    for number, value in enumerate(values):
        text = json.dumps(value) if key == LANGUAGE else str(value)
        if text != before:
            fields = {**frames.at(number).fields(), "text": text}
            messages.append((int(frames.stamps[number]), encode(types.TEXT, fields, 1)[0]))
            before = text
    return Stream(own_topic(key), types.TEXT, messages)
