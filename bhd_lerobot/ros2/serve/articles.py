"""The names of the articles: topics and messages of their bridge, beside ours."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from bhd_lerobot.bodies.body import Arm
from bhd_lerobot.errors import ConfigError, as_text
from bhd_lerobot.robots.host.realtime import LiveHost
from bhd_lerobot.ros2 import messages
from bhd_lerobot.ros2.live.node import Node
from bhd_lerobot.ros2.messages.definitions import register_types
from bhd_lerobot.ros2.messages.parts import header
from bhd_lerobot.ros2.messages.serialize import encode_known
from bhd_lerobot.ros2.messages.types import type_store, type_text
from bhd_lerobot.ros2.messages.ur import TRAJECTORY
from bhd_lerobot.ros2.serve.interface import Names
from bhd_lerobot.ros2.serve.server import Input, Output, State, Topics

PACKAGE = "brain_bridge"
COMMAND_TOPIC, RESULT_TOPIC, STATE_TOPIC = "/brain/command", "/brain/command_result", "/bridge/cerebellum_state"
TWIST_TOPIC = "/high_level_cmd_vel"
TRAJECTORY_TOPIC = "/joint_trajectory_controller/joint_trajectory"
CONTROLLER_TOPIC = "/joint_trajectory_controller/state"
CONTROLLER = "control_msgs/msg/JointTrajectoryControllerState"
_STATE_HZ = 50.0  # `state_publish_rate` of joint_trajectory_controller
# By which fields a message is found among those of a package.
_FIELDS = {
    "command": ("task_id", "target_pose"),
    "result": ("task_id", "success"),
    "state": ("joint_positions", "joint_velocities"),
}
_NUMBER, _NUMBERS = ("float64", "float32"), ("float64[]", "float32[]")
# What is read and written of each, where it is there, and of which types it may be.
_USED: dict[str, dict[str, tuple[str, ...]]] = {
    "command": {
        "header": ("std_msgs/msg/Header",),
        "task_id": ("string",),
        "target_pose": ("geometry_msgs/msg/Pose", "geometry_msgs/msg/PoseStamped"),
        "max_velocity": _NUMBER,
        "max_acceleration": _NUMBER,
    },
    "result": {
        "header": ("std_msgs/msg/Header",),
        "stamp": ("builtin_interfaces/msg/Time",),
        "task_id": ("string",),
        "success": ("bool",),
        "message": ("string",),
    },
    "state": {
        "header": ("std_msgs/msg/Header",),
        "stamp": ("builtin_interfaces/msg/Time",),
        "joint_positions": _NUMBERS,
        "joint_velocities": _NUMBERS,
        "joint_efforts": _NUMBERS,
        "is_moving": ("bool",),
        "emergency_stop": ("bool",),
    },
}


def article_names(articles: bool | str) -> tuple[Names, ...]:
    """Return the names under which the topics of brain and cerebellum are there: ours, and those of the articles.

    Args:
        articles: false for ours alone; true; or the folder of a package of messages, in the form of `colcon`.

    Raises:
        ConfigError: there is no such folder, or its messages are not those.
    """
    if not articles:
        return (Names(),)
    if articles is True:
        package, (_, texts) = PACKAGE, _package(Path(messages.__path__[0]))
    else:
        package, texts = _package(Path(articles).expanduser())
    register_types({f"{package}/msg/{name}": text for name, text in texts.items()})
    types = {role: _find(role, package, texts, articles) for role in _FIELDS}
    theirs = Names(COMMAND_TOPIC, RESULT_TOPIC, STATE_TOPIC, types["command"], types["result"], types["state"])
    return Names(), theirs


def _package(folder: Path) -> tuple[str, dict[str, str]]:
    try:
        name = ElementTree.parse(folder / "package.xml").findtext("name") or ""
        texts = {file.stem: file.read_text("utf-8") for file in sorted(folder.glob("msg/*.msg"))}
    except (OSError, ElementTree.ParseError, UnicodeDecodeError) as error:
        raise ConfigError(
            f"articles is {str(folder)!r}, which is no package of messages ({as_text(error)}). Name the folder that "
            "has package.xml and msg/, or true."
        ) from error
    if not re.fullmatch(r"[a-z]\w*", name):
        raise ConfigError(f"{folder / 'package.xml'} names the package {name!r}; a name is of a-z, 0-9 and _.")
    return name, texts


def _find(role: str, package: str, texts: dict[str, str], articles: bool | str) -> str:
    wanted = _FIELDS[role]
    for name in texts:
        known = dict(type_store().fielddefs[f"{package}/msg/{name}"][1])
        if not known.keys() >= {*wanted}:
            continue
        for field, types in _USED[role].items():
            if field in known and (kind := type_text(known[field])) not in types:
                raise ConfigError(
                    f"articles is {articles!r}; {field} of its message {name}, the {role}, is {kind}; it is "
                    f"{' or '.join(types)}."
                )
        return f"{package}/msg/{name}"
    raise ConfigError(
        f"articles is {articles!r}; none of its messages ({', '.join(texts) or 'there are none'}) is the {role}, which "
        f"has the fields {' and '.join(wanted)}."
    )


class TrajectoryController(Topics):
    """The topics of a `joint_trajectory_controller` in front of a served arm.

    Args:
        follow: takes a trajectory and its topic; returns False if it is refused.
    """

    def __init__(self, host: LiveHost, node: Node, follow: Callable[[Any, str], bool]) -> None:
        self._joints = [f"{joint}_joint" for joint in host.body.need(Arm).chain.joints]
        self._publisher = node.publisher(CONTROLLER_TOPIC, CONTROLLER)
        self.outputs = [Output(_STATE_HZ, self._publish)]
        received = node.subscription(TRAJECTORY_TOPIC, TRAJECTORY)
        self.inputs = [Input(received, lambda message: follow(message, TRAJECTORY_TOPIC))]

    def _publish(self, state: State) -> None:
        count, robot = len(self._joints), state.robot
        wanted, measured = robot.command[:, :count], robot.joint_positions[:, :count]
        speeds = robot.joint_velocities[:, :count]
        points = {
            "reference": {"positions": wanted},
            "feedback": {"positions": measured, "velocities": speeds},
            "error": {"positions": np.subtract(wanted, measured)},
            "output": {"positions": wanted},
        }
        old = {"desired": points["reference"], "actual": points["feedback"]}  # of Humble
        fields = {"header": header(state.stamps), "joint_names": self._joints, **points, **old}
        self._publisher.send(encode_known(CONTROLLER, fields))
