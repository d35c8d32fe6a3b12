"""Which field of which topic is which feature of a robot: one description for bags and for robots on the network."""

from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, fields
from pathlib import Path
from typing import Any, Self

import numpy as np
import yaml
from numpy.typing import NDArray

from bhd_lerobot.errors import ConfigError, as_text, unknown_name
from bhd_lerobot.ros2.messages.definitions import register_types
from bhd_lerobot.ros2.messages.fields import Field
from bhd_lerobot.ros2.messages.parts import header
from bhd_lerobot.ros2.messages.serialize import encode
from bhd_lerobot.ros2.messages.types import type_store

QUATERNION = "geometry_msgs/msg/Quaternion"
IMAGES = ("sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/Image")
HEADER = "std_msgs/msg/Header"


@dataclass(frozen=True)
class FieldConfig:
    """Where a feature is.

    Attributes:
        topic: its topic, such as ``/odom``; without a slash in front it is the same.
        type: of the topic's messages, such as ``nav_msgs/msg/Odometry``.
        field: in a message, see `Field`. A quaternion is read as its yaw [rad].
        scale: the feature is the field times this, plus `offset`; an action is taken back by the inverse.
        offset: see `scale`.
    """

    topic: str
    type: str
    field: str = ""
    scale: float = 1.0
    offset: float = 0.0

    def __post_init__(self) -> None:
        if not (np.isfinite([self.scale, self.offset]).all() and self.scale):
            raise ConfigError(f"scale is {self.scale}, offset {self.offset}; they are finite, and scale is not 0.")


@dataclass(frozen=True)
class ImageConfig:
    """Where a camera's images are.

    Attributes:
        topic: its topic.
        type: of the topic's messages, ``sensor_msgs/msg/CompressedImage`` or ``sensor_msgs/msg/Image``.
        width, height: of an image [px].
    """

    topic: str
    width: int
    height: int
    type: str = IMAGES[0]

    def __post_init__(self) -> None:
        if self.type not in IMAGES:
            raise ConfigError(unknown_name("type of images", self.type, IMAGES))


@dataclass(frozen=True)
class MappingConfig:
    """The topics of a robot.

    Attributes:
        observation: features of the state, in this order.
        action: features of the action, in this order.
        images: cameras by name.
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
            tree = yaml.safe_load(Path(path).read_text())
        except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
            raise ConfigError(
                f"The mapping {path} cannot be read: {as_text(error)}. In YAML a value with [ in it needs quotes."
            ) from error
        kinds: dict[str, Any] = {"observation": FieldConfig, "action": FieldConfig, "images": ImageConfig, "types": str}
        if not isinstance(tree, dict):
            raise ConfigError(f"The mapping {path} is not a mapping of {', '.join(kinds)}.")
        parts: dict[str, dict[str, Any]] = {}
        for section, entries in tree.items():
            if section not in kinds:
                raise ConfigError(f"{path}: {unknown_name('section', section, kinds)}")
            if not isinstance(entries, dict):
                raise ConfigError(f"{path}: {section} is not a mapping of names.")
            parts[section] = {
                str(name): _entry(f"{path}: {section}.{name}", kinds[section], entry) for name, entry in entries.items()
            }
        return cls(**parts)


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
    try:
        return kind(**{key: float(value) if key in ("scale", "offset") else value for key, value in entry.items()})
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{where}: {error}") from error


@dataclass(frozen=True)
class TopicFields:
    """The features of one topic.

    Attributes:
        topic, msgtype: of its messages.
        columns: places of its features among all of them.
        fields: where each of them is in a message.
        scales, offsets: a feature is its field times the scale, plus the offset; shape (len(columns),).
    """

    topic: str
    msgtype: str
    columns: tuple[int, ...]
    fields: tuple[Field, ...]
    scales: NDArray[np.float64]
    offsets: NDArray[np.float64]

    @property
    def has_header(self) -> bool:
        """Whether a message begins with a header, and so with a stamp."""
        first = type_store().fielddefs[self.msgtype][1][:1]
        return bool(first) and first[0][1][1] == HEADER

    def read(self, message: Any) -> NDArray[np.float64]:
        """Return the features in a deserialised message, shape (len(columns),).

        Raises:
            DatasetError: it has no such element.
        """
        values = [_number(one, one.read(message)) for one in self.fields]
        return np.array(values, np.float64) * self.scales + self.offsets

    def encode(self, features: NDArray[np.float64], stamp_ns: int) -> bytes:
        """Return a serialised message with the features, shape (len(columns),), and the stamp [ns] if it has one."""
        tree: dict[str, Any] = {"header": header(np.array([stamp_ns]))} if self.has_header else {}
        for one, value in zip(self.fields, (features - self.offsets) / self.scales, strict=True):
            one.put(tree, value)
        return encode(self.msgtype, tree, 1)[0]


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


def _number(place: Field, value: Any) -> float:
    if place.kind == QUATERNION:
        w, x, y, z = value.w, value.x, value.y, value.z
        return float(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))
    return float(value)
