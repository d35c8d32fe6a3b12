"""Bags of robots that only their export knows: what `bhd-data export` writes down about them is their mapping."""

import json
from dataclasses import dataclass

from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.errors import DatasetError
from bhd_lerobot.ros2.bag.storage.read import Bag
from bhd_lerobot.ros2.messages import types
from bhd_lerobot.ros2.messages.mapping import FieldConfig, MappingConfig
from bhd_lerobot.ros2.messages.serialize import decode


@dataclass(frozen=True)
class Exported:
    """What an exported bag states of its dataset."""

    robot_type: str
    task: str
    fps: int
    mapping: MappingConfig


def exported(bag: Bag) -> Exported | None:
    """Return what a bag states of itself; None of any other, and of one whose numbers are in messages of ROS 2."""
    if types.EPISODE_TOPIC not in bag.topics or bag.topics[types.EPISODE_TOPIC].msgtype != types.EPISODE:
        return None
    try:
        message = decode(types.EPISODE, bag.read([types.EPISODE_TOPIC])[types.EPISODE_TOPIC].data[0])
        topics = [one for one in json.loads(message.topics) if one["feature"] in (keys.OBSERVATION_STATE, keys.ACTION)]
        sections: dict[str, dict[str, FieldConfig]] = {keys.OBSERVATION_STATE: {}, keys.ACTION: {}}
        for one in topics:
            if one["kind"] != "NumbersPart":
                return None
            sections[one["feature"]] |= {
                name: FieldConfig(one["topic"], types.NUMBERS, f"values[names={name}]") for name in one["names"]
            }
    except (DatasetError, IndexError, KeyError, TypeError, ValueError):
        return None  # damaged; import names what it lacks
    if not all(sections.values()):
        return None
    mapping = MappingConfig(sections[keys.OBSERVATION_STATE], sections[keys.ACTION])
    return Exported(message.robot_type, message.task, message.fps, mapping)
