"""Which topics of a bag are read for what, and who published them."""

import contextlib
from collections.abc import Mapping

from bhd_lerobot.errors import DatasetError
from bhd_lerobot.ros2.bag.storage.read import Bag, Topic
from bhd_lerobot.ros2.messages.base import BareTwistPart, GyroPart, OdometryPart, ScanPart, TwistPart
from bhd_lerobot.ros2.messages.images import COMPRESSED, IMAGE
from bhd_lerobot.ros2.messages.parts import Part
from bhd_lerobot.ros2.messages.serialize import decode
from bhd_lerobot.ros2.messages.views import JOINT_STATE

_BASE = (ScanPart.msgtype, OdometryPart.msgtype)
_NAMED = 6  # joints


def _refuse_arm(bag: Bag) -> None:
    """Refuse a bag of an arm: it has joints that are no wheels, no scans and no odometry."""
    if any(topic.msgtype in _BASE and topic.count for topic in bag.topics.values()):
        return
    for topic in bag.topics.values():
        joints = _joints(bag, topic.name) if topic.msgtype == JOINT_STATE and topic.count else []
        if joints and not any("wheel" in joint for joint in joints):
            more = ", …" if len(joints) > _NAMED else ""
            raise DatasetError(
                f"{bag.path} seems to be of an arm: {topic.name} has the joints {', '.join(joints[:_NAMED])}{more}, "
                "and there are no scans and no odometry. bhd-data import is for bags of a TurtleBot3: it needs scans, "
                "odometry and speed commands; for an arm's bags there is none, except for those that bhd-data export "
                "wrote."
            )


def _joints(bag: Bag, topic: str) -> list[str]:
    """Return the joints of the first message of a topic; none if that cannot be read."""
    with contextlib.suppress(DatasetError):
        for *_, payload in bag.messages((topic,)):
            return list(decode(JOINT_STATE, payload).name)
    return []


TYPES = {
    "scan": (ScanPart.msgtype,),
    "odom": (OdometryPart.msgtype,),
    "cmd": (TwistPart.msgtype, BareTwistPart.msgtype),
    "imu": (GyroPart.msgtype,),
    "camera": (IMAGE, COMPRESSED),
}
"""What is read -> the types of message that it is read from."""

_MEANING = {
    "scan": "the scan",
    "odom": "the robot's speed",
    "cmd": "the action",
    "imu": "the yaw rate of the gyroscope",
    "camera": "the image",
}


def wanted_topics(bag: Bag, names: Mapping[str, str]) -> dict[str, Topic]:
    """Return the topics that roles are read from.

    Args:
        names: role, a key of `TYPES`, of a camera with its name behind a slash -> topic; ``scan`` is ``/scan``, too.
    """
    found = {role: bag.topics.get(name) or bag.topics.get(other_form(name)) for role, name in names.items()}
    lacking = [_lacking(bag, role, names[role], topic) for role, topic in found.items() if not topic or not topic.count]
    if lacking:
        _refuse_arm(bag)
        there = ", ".join(f"{topic.name} ({topic.msgtype}, {topic.count})" for topic in bag.topics.values()) or "none"
        raise DatasetError(f"{bag.path} has {' It has '.join(lacking)} The bag has: {there}.{_damage(bag)}")
    return {role: _checked(bag, role, topic) for role, topic in found.items() if topic}


def other_form(name: str) -> str:
    """Return a topic's name with the slash in front that it lacks, or without it: some writers leave it out."""
    return name[1:] if name.startswith("/") else f"/{name}"


def _lacking(bag: Bag, role: str, name: str, topic: Topic | None) -> str:
    """Return the end of a sentence: which topic there is not, and what may be read in its place."""
    kind = role.partition("/")[0]
    types = TYPES[kind]
    fitting = [one.name for one in bag.topics.values() if one.msgtype in types and one.count]
    remedy = (
        f"Name another one with --{kind}. Of the right type: {', '.join(fitting)}."
        if fitting
        else f"--{kind} can name no other one: none is of type {' or '.join(types)}."
    )
    if kind == "odom":
        remedy += " --no_odom does without: the state is the scan alone."
    return f"{'no topic' if topic is None else 'no message of'} {name}, which {_MEANING[kind]} is read from. {remedy}"


def _checked(bag: Bag, role: str, topic: Topic) -> Topic:
    kind = role.partition("/")[0]
    if topic.msgtype not in TYPES[kind]:
        raise DatasetError(
            f"{topic.name} in {bag.path} is of type {topic.msgtype}; valid for --{kind}: {', '.join(TYPES[kind])}."
        )
    if topic.others:
        raise DatasetError(
            f"{topic.name} in {bag.path} has messages of several types, {', '.join((topic.msgtype, *topic.others))}, "
            f"and it is not known which of them is {_MEANING[kind]}. Make a bag with one of them: ros2 bag convert."
        )
    if topic.serialisation != "cdr":
        raise DatasetError(
            f"{topic.name} in {bag.path} is serialised as {topic.serialisation!r}; only cdr can be read."
        )
    return topic


def exported_topic(bag: Bag, role: str, part: Part) -> Topic:
    """Return the topic of an exported bag that carries numbers of a feature."""
    topic = bag.topics.get(part.topic)
    if topic is None or not topic.count:
        raise DatasetError(
            f"{bag.path} has no message of {part.topic}, which carries {role.removesuffix(part.topic)}, as "
            f"/bhd/episode lists.{_damage(bag)} Export the dataset again."
        )
    if topic.msgtype != part.msgtype or topic.others:
        raise DatasetError(
            f"{part.topic} in {bag.path} is of type {', '.join((topic.msgtype, *topic.others))}, not {part.msgtype} "
            "alone, as described in /bhd/episode. Export the dataset again."
        )
    return topic


def _damage(bag: Bag) -> str:
    return "".join(f" Damaged: {problem}." for problem in bag.problems)


def static_topics(scan: str) -> set[str]:
    """Return the topics that may say how the scanner is mounted: of all robots, and of the scan's namespace."""
    names = {"/tf_static", f"{scan.rpartition('/')[0]}/tf_static"}
    return names | {other_form(name) for name in names}


def publisher_notes(bag: Bag, wanted: Mapping[str, Topic]) -> list[str]:
    """Return, in sentences, which wanted topics, by role, may have more than one publisher."""
    notes = []
    for role, topic in wanted.items():
        counts = "newest command counts, as it did for the robot" if role == "cmd" else "newest message counts"
        if topic.connections:
            each = " and ".join(str(count) for count in topic.connections)
            notes.append(
                f"{topic.name} has messages of {len(topic.connections)} connections ({each}), so of several "
                f"publishers; the {counts}, whichever publisher sent it"
            )
        elif topic.publishers > 1:
            notes.append(
                f"{topic.name} had {topic.publishers} publishers when the recording began. Which of them sent a "
                f"message is not in the bag; the {counts}, whichever publisher sent it"
            )
    if "cmd" not in wanted:
        return notes  # an exported bag, whose other topics are known
    read = wanted["cmd"].name
    others = [one for one in bag.topics.values() if one.msgtype in TYPES["cmd"] and one.count and one.name != read]
    if others:
        there = ", ".join(f"{other.name} ({other.count})" for other in others)
        notes.append(
            f"there are commands on other topics, too: {there}. The action is of {read} alone ({wanted['cmd'].count}); "
            "if that is not what drove the robot, name the topic with --cmd"
        )
    return notes
