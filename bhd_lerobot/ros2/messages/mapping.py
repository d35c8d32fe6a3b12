"""Which field of which topic is which feature of a robot: one description for bags and for robots on the network."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
import yaml
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import LidarSpec
from bhd_lerobot.errors import ConfigError, DatasetError, as_text, unknown_name
from bhd_lerobot.options.unique_keys import UniqueKeys
from bhd_lerobot.ros2.messages.base import unwrapped, yaw_of
from bhd_lerobot.ros2.messages.definitions import register_types
from bhd_lerobot.ros2.messages.fields import Field, elements_of
from bhd_lerobot.ros2.messages.parts import header
from bhd_lerobot.ros2.messages.serialize import encode
from bhd_lerobot.ros2.messages.table import JOINTS, SCAN
from bhd_lerobot.ros2.messages.types import type_store

QUATERNION = "geometry_msgs/msg/Quaternion"
IMAGES = ("sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/Image")
HEADER = "std_msgs/msg/Header"


@dataclass(frozen=True)
class FieldConfig:
    """Where a feature is.

    Attributes:
        topic: its topic, such as ``/odom``; without a slash in front it is the same.
        field: in a message, see `Field`. A quaternion is read as its yaw [rad].
        scale: the feature is the field times this, plus `offset`; an action is taken back by the inverse.
        beams: of a LaserScan, how many features it becomes: ``NAME_000.pos`` … [m], the first straight ahead,
            counter-clockwise. 0 for one feature.
        range_min, range_max: of these features [m]; no return is `range_max`.
    """

    topic: str
    type: str
    field: str = ""
    scale: float = 1.0
    offset: float = 0.0
    beams: int = 0
    range_min: float = 0.0
    range_max: float = 0.0

    def __post_init__(self) -> None:
        if not (np.isfinite([self.scale, self.offset]).all() and self.scale):
            raise ConfigError(f"scale is {self.scale}, offset {self.offset}; they are finite, and scale is not 0.")
        if not self.beams:
            return
        is_scan = self.type == SCAN and self.field in ("", "ranges")
        if not is_scan or not isinstance(self.beams, int) or self.beams < 0:
            raise ConfigError(f"beams is {self.beams!r}; it is a whole number, of the ranges of a {SCAN}.")
        if not 0 <= self.range_min < self.range_max < np.inf:
            raise ConfigError(
                f"range_min is {self.range_min}, range_max {self.range_max}; beams need both, and the second is larger."
            )

    @property
    def lidar(self) -> LidarSpec:
        """The scanner whose beams the features are."""
        return LidarSpec("", self.beams, self.range_min, self.range_max, rate_hz=5, noise_std=0.0)

    def names(self, name: str) -> tuple[str, ...]:
        """Return the features of an entry of this name."""
        return tuple(f"{name}_{beam:03d}.pos" for beam in range(self.beams)) if self.beams else (name,)


@dataclass(frozen=True)
class ImageConfig:
    """Where a camera's images are.

    Attributes:
        width, height: of an image [px]; 0 for those of the first image of a bag.
    """

    topic: str
    width: int = 0
    height: int = 0
    type: str = IMAGES[0]

    def __post_init__(self) -> None:
        if self.type not in IMAGES:
            raise ConfigError(unknown_name("type of images", self.type, IMAGES))


@dataclass(frozen=True)
class MappingConfig:
    """The topics of a robot.

    Attributes:
        types: definitions of message types that are not ROS 2's own, in its message language, by name.
    """

    observation: dict[str, FieldConfig] = field(default_factory=dict)
    action: dict[str, FieldConfig] = field(default_factory=dict)
    images: dict[str, ImageConfig] = field(default_factory=dict)
    types: dict[str, str] = field(default_factory=dict)

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Return the mapping in a YAML file.

        Raises:
            ConfigError: it cannot be read, or has other keys.
        """
        try:
            tree = yaml.load(Path(path).expanduser().read_text("utf-8"), UniqueKeys)
        except OSError as error:
            raise ConfigError(f"The mapping {path} cannot be read: {error.strerror}.") from error
        except (UnicodeDecodeError, yaml.YAMLError) as error:
            hint = " In YAML a value with [ in it needs quotes." * isinstance(error, yaml.MarkedYAMLError)
            raise ConfigError(f"The mapping {path} cannot be read: {as_text(error)}.{hint}") from error
        return cls.of(tree, str(path))

    @classmethod
    def of(cls, tree: Any, where: str) -> Self:
        """Return the mapping in nested values, as a file holds them."""
        kinds: dict[str, Any] = {"observation": FieldConfig, "action": FieldConfig, "images": ImageConfig, "types": str}
        if not isinstance(tree, dict):
            raise ConfigError(f"{where} is not a mapping of {', '.join(kinds)}.")
        parts: dict[str, dict[str, Any]] = {}
        for section, entries in tree.items():
            if section not in kinds:
                raise ConfigError(f"{where}: {unknown_name('section', section, kinds)}")
            if not isinstance(entries, dict):
                raise ConfigError(f"{where}: {section} is not a mapping of names.")
            parts[section] = {
                str(name): _entry(f"{where}: {section}.{name}", kinds[section], entry)
                for name, entry in entries.items()
            }
        return cls(**parts)

    def over(self, other: "MappingConfig") -> "MappingConfig":
        """Return another mapping with the entries of this one added, or in their place."""
        return MappingConfig(**{one.name: getattr(other, one.name) | getattr(self, one.name) for one in fields(self)})


def _entry(where: str, kind: Any, entry: Any) -> Any:
    if kind is str:
        return str(entry)
    names = [one.name for one in fields(kind)]
    if not isinstance(entry, dict):
        raise ConfigError(f"{where} is {entry!r}; it is a mapping of {', '.join(names)}.")
    for key in entry:
        if key not in names:
            raise ConfigError(f"{where}: {unknown_name('key', key, names)}")
    missing = [one.name for one in fields(kind) if one.default is MISSING and one.name not in entry]
    if missing:
        raise ConfigError(f"{where} has no {' and no '.join(missing)}.")
    values = {}
    try:
        for one in fields(kind):
            if one.name in entry:
                values[one.name] = value = float(entry[one.name]) if one.type is float else entry[one.name]
                if not isinstance(value, one.type) or isinstance(value, bool):  # type: ignore[arg-type]
                    raise ConfigError(f"{one.name} is {value!r}; it is {_WORDS[one.type]}.")
        return kind(**values)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{where}: {error}") from error


_WORDS: dict[Any, str] = {str: "text", int: "a whole number"}


@dataclass(frozen=True)
class TopicFields:
    """The features of one topic.

    Attributes:
        columns: places of its features among all of them.
        scales, offsets: a feature is its field times the scale, plus the offset; shape (len(columns),).
    """

    topic: str
    msgtype: str
    columns: tuple[int, ...]
    fields: tuple[Field, ...]
    scales: NDArray[np.float64]
    offsets: NDArray[np.float64]

    @property
    def width(self) -> int:
        """How many features."""
        return len(self.columns)

    def parts(self) -> "list[TopicFields]":
        """Return the features that come in the same message for certain, each that is selected by a name by itself."""
        named = [k for k, one in enumerate(self.fields) if one.key]
        groups = [[k for k in range(self.width) if k not in named], *[[k] for k in named]]
        return [
            replace(
                self,
                columns=tuple(self.columns[k] for k in group),
                fields=tuple(self.fields[k] for k in group),
                scales=self.scales[group],
                offsets=self.offsets[group],
            )
            for group in groups
            if group
        ]

    @property
    def turns(self) -> dict[int, float]:
        """A whole turn of each feature that is a yaw, in its unit, by its place in `columns`."""
        yaws = zip(self.fields, self.scales.tolist(), strict=True)
        return {k: 2 * np.pi * abs(scale) for k, (one, scale) in enumerate(yaws) if one.kind == QUATERNION}

    def read(self, message: Any) -> NDArray[np.float64]:
        """Return the features in a deserialised message, shape (len(columns),).

        Raises:
            DatasetError: it has no such element.
        """
        values, lacking = self.read_present(message)
        if lacking:
            raise DatasetError(next(iter(lacking.values())))
        return values

    def read_present(self, message: Any) -> tuple[NDArray[np.float64], dict[int, str]]:
        """Return the features in a message, shape (len(columns),), and why it does not have some, by their places."""
        values, lacking = np.zeros(len(self.fields)), {}
        for place, one in enumerate(self.fields):
            try:
                values[place] = _number(one, one.read(message))
            except DatasetError as error:
                lacking[place] = str(error)
        return values * self.scales + self.offsets, lacking

    def encode(self, features: NDArray[np.float64], stamp_ns: int) -> bytes:
        """Return a serialised message with the features, shape (len(columns),), and the stamp [ns] if it has one."""
        tree: dict[str, Any] = {"header": header(np.array([stamp_ns]))} if has_header(self.msgtype) else {}
        for one, value in zip(self.fields, (features - self.offsets) / self.scales, strict=True):
            one.put(tree, value)
        return encode(self.msgtype, tree, 1)[0]


class FieldsReader:
    """Reads the features of one topic message by message: yaws count on beyond half a turn."""

    def __init__(self, fields: TopicFields, names: Sequence[str]) -> None:
        self._fields, self._names, self.width = fields, names, fields.width
        self._last = dict.fromkeys(fields.turns, 0.0)

    def read(self, message: Any) -> NDArray[np.float64]:
        """Return the features, shape (width,).

        Raises:
            DatasetError: the message lacks an element, or a feature is not finite.
        """
        values = self._fields.read(message)
        if not np.isfinite(values).all():
            wrong = int(np.flatnonzero(~np.isfinite(values))[0])
            raise DatasetError(f"{self._names[wrong]} is {values[wrong]}, which is not a finite number")
        for column, turn in self._fields.turns.items():
            values[column] = unwrapped(np.array([self._last[column], values[column]]), turn)[1]
            self._last[column] = float(values[column])
        return values


def features_of(section: Mapping[str, FieldConfig]) -> tuple[str, ...]:
    """Return the names of a section's features."""
    return tuple(feature for name, one in section.items() for feature in one.names(name))


def has_header(msgtype: str) -> bool:
    """Return whether a type's messages begin with a header, and so with a stamp."""
    first = type_store().fielddefs[msgtype][1][:1]
    return bool(first) and first[0][1][1] == HEADER


def topics_of(section: Mapping[str, FieldConfig], types: Mapping[str, str]) -> list[TopicFields]:
    """Return features grouped by topic, in the order of their first feature.

    Raises:
        ConfigError: a type is not known, or has no such field, or it is no number.
    """
    register_types(types)
    grouped: dict[tuple[str, str], list[tuple[int, FieldConfig, Field]]] = {}
    for column, (name, config) in enumerate(section.items()):
        topic = "/" + config.topic.lstrip("/")
        try:
            place = Field(config.type, config.field)
        except ConfigError as error:
            raise ConfigError(f"{name}: {error}") from error
        if place.kind not in ("number", QUATERNION):
            raise ConfigError(f"{name}: {config.field} of {config.type} is {place.kind}; a feature is one number.")
        grouped.setdefault((topic, config.type), []).append((column, config, place))
    found = [
        TopicFields(
            topic,
            msgtype,
            tuple(column for column, _, _ in entries),
            tuple(place for *_, place in entries),
            np.array([config.scale for _, config, _ in entries]),
            np.array([config.offset for _, config, _ in entries]),
        )
        for (topic, msgtype), entries in grouped.items()
    ]
    names = [one.topic for one in found]
    for topic in names:
        if names.count(topic) > 1:
            kinds = ", ".join(one.msgtype for one in found if one.topic == topic)
            raise ConfigError(f"{topic} is mapped with several types: {kinds}. A topic has one.")
    return found


def fields_of(topic: str, msgtype: str, paths: Iterable[str]) -> TopicFields:
    """Return what reads and writes some fields of a topic's messages, in order."""
    [found] = topics_of({path: FieldConfig(topic, msgtype, path) for path in paths}, {})
    return found


def sendable_topics(section: Mapping[str, FieldConfig], types: Mapping[str, str]) -> list[TopicFields]:
    """Return features of an action grouped by topic, if whole messages can be made of them.

    Raises:
        ConfigError: as for `topics_of`, or what no feature gives would be sent as 0, or without a name.
    """
    found = topics_of(section, types)
    names = list(section)
    for topic in found:
        mapped = ", ".join(names[column] for column in topic.columns)
        if topic.turns:
            raise ConfigError(
                f"{mapped}: a quaternion of {topic.msgtype} is read as its yaw, and cannot be sent. Map a number."
            )
        for type_, remedy in _NAMELESS.items():
            if topic.msgtype == type_ and (type_ != JOINTS or any(not one.key for one in topic.fields)):
                raise ConfigError(
                    f"{mapped}: a {type_} on {topic.topic} would be sent without the joints' names. {remedy}"
                )
        for path, (there, size) in elements_of(topic.fields).items():
            if missing := [str(k) for k in range(size) if k not in there]:
                raise ConfigError(
                    f"{mapped}: of {path} on {topic.topic} the mapping has no element {', '.join(missing)}; they would "
                    "be sent as 0. Map every element."
                )
    return found


_NAMELESS = {
    "trajectory_msgs/msg/JointTrajectory": "Send positions to a position controller (std_msgs/msg/Float64MultiArray), "
    "or use --robot.plant=ros2 with a robot type that has one.",
    JOINTS: "Name each joint: position[name=JOINT].",
}
"""Messages whose receivers go by names of joints -> what to map instead."""


def _number(place: Field, value: Any) -> float:
    if place.kind == QUATERNION:
        return yaw_of(value.w, value.x, value.y, value.z)
    return float(value)
