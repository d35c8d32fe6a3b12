"""Which topics of a bag are read for what, and who published them."""

import difflib
from collections.abc import Sequence

from bhd_lerobot.errors import DatasetError
from bhd_lerobot.ros2.bag.importer.sources import Source
from bhd_lerobot.ros2.bag.storage.read import Bag, Topic

_OTHERS = (
    " Without --map, bhd-data import is for bags of a TurtleBot3. --map=FILE.yaml names the fields of any other robot, "
    "--map=ur5 those of a UR5 as bhd-data export writes them."
)


def wanted_topics(bag: Bag, sources: Sequence[Source]) -> list[tuple[Source, Topic]]:
    """Return the topics that are read; ``scan`` is ``/scan``, too.

    Raises:
        DatasetError: some are missing, all of which are named, or of another type.
    """
    found = [(one, bag.topics.get(one.topic) or bag.topics.get(other_form(one.topic))) for one in sources]
    lacking = [_lacking(bag, source, topic) for source, topic in found if not topic or not topic.count]
    if lacking:
        others = _OTHERS * any(source.option == "--scan" for source in sources)
        there = ", ".join(f"{topic.name} ({topic.msgtype}, {topic.count})" for topic in bag.topics.values()) or "none"
        raise DatasetError(f"{bag.path} has {' It has '.join(lacking)} The bag has: {there}.{others}{_damage(bag)}")
    return [(source, _checked(bag, source, topic)) for source, topic in found if topic]


def other_form(name: str) -> str:
    """Return a topic's name with the slash in front that it lacks, or without it: some writers leave it out."""
    return name[1:] if name.startswith("/") else f"/{name}"


def _lacking(bag: Bag, source: Source, topic: Topic | None) -> str:
    """Return the end of a sentence: which topic there is not, and what may be read in its place."""
    fitting = [one.name for one in bag.topics.values() if one.msgtype in source.readers and one.count]
    if fitting:
        near = difflib.get_close_matches(source.topic, fitting, n=1)
        hint = f"Did you mean {near[0]}? " if near else ""
        remedy = f"{hint}Name another one with {source.option}. Of the right type: {', '.join(fitting)}."
    else:
        remedy = f"{source.option} can name no other one: none is of type {' or '.join(source.readers)}."
    if source.option == "--odom":
        remedy += " --no_odom does without: the state is the scan alone."
    what = "no topic" if topic is None else "no message of"
    return f"{what} {source.topic}, which {source.meaning} is read from. {remedy}"


def _checked(bag: Bag, source: Source, topic: Topic) -> Topic:
    if topic.msgtype not in source.readers:
        raise DatasetError(
            f"{topic.name} in {bag.path} is of type {topic.msgtype}; valid for {source.option}: "
            f"{', '.join(source.readers)}."
        )
    if topic.others:
        raise DatasetError(
            f"{topic.name} in {bag.path} has messages of several types, {', '.join((topic.msgtype, *topic.others))}, "
            f"and it is not known which of them is {source.meaning}. Make a bag with one of them: ros2 bag convert."
        )
    if topic.serialisation != "cdr":
        raise DatasetError(
            f"{topic.name} in {bag.path} is serialised as {topic.serialisation!r}; only cdr can be read."
        )
    return topic


def _damage(bag: Bag) -> str:
    return "".join(f" Damaged: {problem}." for problem in bag.problems)


def publisher_notes(bag: Bag, wanted: Sequence[tuple[Source, Topic]]) -> list[str]:
    """Return, in sentences, which topics that are read may have more than one publisher."""
    notes = []
    for source, topic in {topic.name: (source, topic) for source, topic in wanted}.values():
        counts = "newest command counts, as it did for the robot" if source.is_action else "newest message counts"
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
        if source.option == "--cmd":
            notes += _other_commands(bag, source, topic)
    return notes


def _other_commands(bag: Bag, source: Source, read: Topic) -> list[str]:
    others = [
        one for one in bag.topics.values() if one.msgtype in source.readers and one.count and one.name != read.name
    ]
    there = ", ".join(f"{other.name} ({other.count})" for other in others)
    return [
        f"there are commands on other topics, too: {there}. The action is of {read.name} alone ({read.count}); "
        f"if that is not what drove the robot, name the topic with {source.option}"
    ] * bool(others)
