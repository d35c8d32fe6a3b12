"""Which topics of a bag are published, and how: the recorded quality of service, and what commands a robot."""

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from bhd_lerobot.errors import ConfigError, DatasetError, unknown_name
from bhd_lerobot.ros2.bag.storage.read import Bag, Topic
from bhd_lerobot.ros2.live.network import Qos
from bhd_lerobot.ros2.messages.definitions import find_type, register_message

_ALL, _BEST_EFFORT, _LATCHED = (2, "keep_all"), (2, "best_effort"), (1, "transient_local")  # as bags have it
_LEAST_DEPTH, _MOST_DEPTH, _MOST_LATCHED = 200, 10_000, 100
_COMMANDS = re.compile(r"cmd|command|setpoint|goal|trajectory$|emergency|(^|/)e?stop", re.IGNORECASE)
_NAME = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")
_COMMAND_TYPES = (
    "geometry_msgs/msg/Twist",
    "geometry_msgs/msg/TwistStamped",
    "trajectory_msgs/msg/JointTrajectory",
    "ackermann_msgs/msg/AckermannDriveStamped",
    "bhd_interfaces/msg/BrainCommand",
)


@dataclass(frozen=True)
class Offer:
    """A topic that is published."""

    topic: str
    msgtype: str
    count: int
    qos: Qos

    @property
    def commands(self) -> bool:
        """Whether its name or type is one of those that command a robot."""
        return self.msgtype in _COMMAND_TYPES or _COMMANDS.search(self.topic) is not None


def offers_of(bag: Bag, wanted: Collection[str], distro: str) -> tuple[list[Offer], dict[str, str]]:
    """Return what is published of a bag, and why topics are left out.

    Args:
        distro: whose definitions are used of types that the bag does not define.

    Raises:
        ConfigError: the bag has no such topic.
    """
    names = ["/" + name.lstrip("/") for name in wanted]
    topics = {"/" + name.lstrip("/"): topic for name, topic in bag.topics.items()}
    for name in names:
        if name not in topics:
            raise ConfigError(f"{unknown_name('topic', name, sorted(topics))} These are in {bag.path}.")
    found, left_out = [], {}
    for name, topic in topics.items():
        if (names and name not in names) or not topic.count:
            continue
        if topic.others:
            left_out[name] = f"it has messages of several types: {', '.join((topic.msgtype, *topic.others))}."
        elif topic.serialisation != "cdr":
            left_out[name] = f"its messages are serialised as {topic.serialisation!r}, not as ROS 2 does (cdr)."
        elif not _NAME.fullmatch(name):
            left_out[name] = "no topic of ROS 2 has such a name."
        else:
            try:
                _define(topic.msgtype, bag.definitions, distro)
            except ConfigError as error:
                left_out[name] = str(error)
                continue
            found.append(Offer(name, topic.msgtype, topic.count, recorded_qos(topic)))
    if not found:
        reasons = " ".join(f"{name}: {reason}" for name, reason in left_out.items())
        raise DatasetError(f"{bag.path} has no message that can be published. {reasons}".rstrip())
    return found, left_out


def _define(msgtype: str, definitions: Mapping[str, str], distro: str) -> None:
    """Make a type known, as another process may have defined it in the bag; what is known already stays."""
    try:
        find_type(msgtype, distro)
    except ConfigError:
        if msgtype not in definitions:
            raise
        register_message(msgtype, definitions[msgtype])


def recorded_qos(topic: Topic) -> Qos:
    """Return a quality of service that serves all whom the recorded publishers served.

    One publisher takes the place of several: of a topic that is latched it keeps what all of them kept.
    """
    profiles = [one for one in topic.profiles if isinstance(one, Mapping)]
    if not profiles:
        return Qos()
    depths = [_depth(one) for one in profiles]
    latched = any(one.get("durability") in _LATCHED for one in profiles)
    depth = 0 if 0 in depths else max(*depths, _LEAST_DEPTH)
    if latched:
        depth = max(sum(depths), min(topic.count, _MOST_LATCHED))
    reliable = latched or any(one.get("reliability") not in _BEST_EFFORT for one in profiles)
    return Qos(min(depth, _MOST_DEPTH), reliable, latched)


def _depth(profile: Mapping[str, Any]) -> int:
    depth = profile.get("depth")
    if profile.get("history") in _ALL:
        return 0
    return depth if isinstance(depth, int) and depth > 0 else 10


def described(offers: Sequence[Offer]) -> list[str]:
    """Return a line about each topic."""
    width = max(len(one.topic) for one in offers)
    kind = max(len(one.msgtype) for one in offers)
    return [
        f"{one.topic:<{width}}  {one.msgtype:<{kind}}  {one.count:>7} messages, {one.qos}"
        + (", commands a robot" if one.commands else "")
        for one in offers
    ]
