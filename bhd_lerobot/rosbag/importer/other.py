"""Bags of robots that nothing can be resampled of: arms."""

from collections.abc import Mapping
from typing import Any

from bhd_lerobot.errors import DatasetError
from bhd_lerobot.rosbag.exporter.episode import EPISODE_TOPIC
from bhd_lerobot.rosbag.importer.headers import is_ours
from bhd_lerobot.rosbag.messages import types
from bhd_lerobot.rosbag.messages.base import OdometryPart, ScanPart
from bhd_lerobot.rosbag.messages.cdr_read import decode
from bhd_lerobot.rosbag.messages.views import JOINT_STATE
from bhd_lerobot.rosbag.storage.read import Bag, Topic

_ROBOT = "turtlebot3"
_BASE = (ScanPart.msgtype, OdometryPart.msgtype)
_NAMED = 6  # joints


def told_other_robot(bag: Bag, topics: Mapping[str, Topic]) -> str | None:
    """Return, in sentences, that a bag is not of a TurtleBot3 and what can be done; None if nothing says so.

    Args:
        bag: the bag.
        topics: what it has.
    """
    only = "is for bags of a TurtleBot3: it needs scans, odometry and speed commands"
    if is_ours(topics):
        robot = _first(bag, EPISODE_TOPIC, types.EPISODE, "robot_type")
        if robot in (None, _ROBOT):
            return None
        return (
            f"{bag.path} is of the robot {str(robot)!r}, as {EPISODE_TOPIC} says; --resample {only}. Leave --resample "
            "out: the bag then comes back as the dataset that it was exported from."
        )
    if any(topic.msgtype in _BASE and topic.count for topic in topics.values()):
        return None
    for topic in topics.values():
        joints = _first(bag, topic.name, JOINT_STATE, "name") if topic.msgtype == JOINT_STATE and topic.count else None
        # A base has the joints of its wheels.
        if joints is not None and len(joints) and not any("wheel" in joint for joint in joints):
            more = ", …" if len(joints) > _NAMED else ""
            return (
                f"{bag.path} seems to be of an arm: {topic.name} has the joints {', '.join(joints[:_NAMED])}{more}, "
                f"and there are no scans and no odometry. bhd-data import {only}; for an arm's bags there is none, "
                "except for those that bhd-data export wrote."
            )
    return None


def _first(bag: Bag, topic: str, msgtype: str, field: str) -> Any:
    """Return a field of the first message of a topic; None if that cannot be read."""
    try:
        for _, payload in bag.payloads(topic):
            return decode(msgtype, [payload], (field,))[field][0]
    except DatasetError:
        pass
    return None
