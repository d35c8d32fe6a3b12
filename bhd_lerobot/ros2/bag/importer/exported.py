"""Bags of robots that only their export knows: what `bhd-data export` writes down about them is their mapping."""

import json
from dataclasses import dataclass, replace

from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.errors import ConfigError, DatasetError
from bhd_lerobot.ros2.bag.importer.options import ImportOptions
from bhd_lerobot.ros2.bag.storage.read import Bag
from bhd_lerobot.ros2.messages import types
from bhd_lerobot.ros2.messages.mapping import FieldConfig, MappingConfig
from bhd_lerobot.ros2.messages.serialize import decode
from bhd_lerobot.tasks.task import OUTCOMES


@dataclass(frozen=True)
class Exported:
    """What an exported bag states of its dataset, and of the episode in it; no outcome if that is not known."""

    robot_type: str
    task: str
    outcome: str | None
    fps: int
    mapping: MappingConfig


def exported(bag: Bag) -> Exported | None:
    """Return what a bag states of itself; None of any other, and of one whose numbers are in messages of ROS 2."""
    if types.EPISODE_TOPIC not in bag.topics or bag.topics[types.EPISODE_TOPIC].msgtype != types.EPISODE:
        return None
    try:
        messages = bag.read([types.EPISODE_TOPIC])[types.EPISODE_TOPIC].data
        message = decode(types.EPISODE, messages[0])
        outcome = json.loads(message.metadata).get("outcome")
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
    if len(messages) > 1:
        raise ConfigError(
            f"{bag.path} holds {len(messages)} episodes, whose instructions and outcomes may differ. Export a bag for "
            "each, without --one_bag, or name the fields with --map."
        )
    mapping = MappingConfig(sections[keys.OBSERVATION_STATE], sections[keys.ACTION])
    return Exported(message.robot_type, message.task, outcome if outcome in OUTCOMES else None, message.fps, mapping)


def as_stated(bag: Bag, options: ImportOptions) -> ImportOptions:
    """Return the options of one of several exported bags: with the instruction and the outcome of its episode.

    Raises:
        DatasetError: it is of another robot or another rate than the first, or states nothing.
    """
    one = exported(bag)
    if one is None:
        raise DatasetError(
            f"The first bag was exported from a dataset; {bag.path} was not, or is damaged. Leave it out."
        )
    if one.robot_type != options.robot_type or options.stated_fps not in (0, one.fps):
        raise DatasetError(
            f"The first bag is of {options.robot_type!r} at {options.fps} fps, and {bag.path} of {one.robot_type!r} at "
            f"{one.fps} fps. Import them one by one; --fps sets one rate for all."
        )
    return replace(options, task=options.task or one.task, outcome=options.outcome or one.outcome)
