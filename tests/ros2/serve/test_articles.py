"""The articles' names: topics, and messages of a user's own package, beside ours."""

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from bhd_lerobot.errors import ConfigError
from bhd_lerobot.ros2.live.network import EVERY
from bhd_lerobot.ros2.messages.definitions import register_types
from bhd_lerobot.ros2.serve import articles
from tests.ros2.peer_env import Peer
from tests.ros2.programs import Side, served
from tests.waiting import until

# As somebody else may have written them: a stamp in place of a header, a pose with a header of its own, other fields.
MESSAGES = {
    "BrainCommand": """
string task_id
string task_type
geometry_msgs/PoseStamped target_pose
float64[] joint_targets
float64 max_velocity
builtin_interfaces/Time timestamp
""",
    "TaskResult": "builtin_interfaces/Time stamp\nstring task_id\nbool success\nfloat64 duration\nstring message\n",
    "CerebellumState": """
builtin_interfaces/Time stamp
string mode
float64[] joint_positions
float64[] joint_velocities
bool is_moving
bool emergency_stop
""",
}
PACKAGE = "their_bridge"
XML = f'<?xml version="1.0"?><package format="3"><name>{PACKAGE}</name></package>'
TARGET = {"position": {"x": 0.5, "y": 0.1, "z": 0.4}, "orientation": {"y": 1.0, "w": 0.0}}


def package(folder: Path, messages: dict[str, str], xml: str = XML) -> Path:
    (folder / "msg").mkdir(parents=True)
    (folder / "package.xml").write_text(xml)
    for name, text in messages.items():
        (folder / "msg" / f"{name}.msg").write_text(text)
    return folder


def domain_of(side: Side) -> int:
    return side.node.network.domain_number


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Side]:
    folder = package(tmp_path_factory.mktemp("theirs") / "src", MESSAGES)
    register_types({f"{PACKAGE}/msg/{name}": text for name, text in MESSAGES.items()})
    yield from served("ur5", tmp_path_factory.mktemp("arm"), f"--articles={folder}")


def test_a_goal_in_messages_of_their_package_has_one_result_under_either_name(arm: Side) -> None:
    results = arm.node.subscription(articles.RESULT_TOPIC, f"{PACKAGE}/msg/TaskResult", EVERY)
    states = arm.node.subscription(articles.STATE_TOPIC, f"{PACKAGE}/msg/CerebellumState")
    start = arm.joints
    for name in ("test_move_001", "test_move_001"):  # again, after it has ended
        goal = {"task_id": name, "target_pose": {"pose": TARGET}, "max_velocity": 1.0}
        arm.send(articles.COMMAND_TOPIC, f"{PACKAGE}/msg/BrainCommand", goal)
        [ours] = arm.ended(1)
        [theirs] = until(results.take, "a result comes")
        assert (theirs.message().task_id, theirs.message().success) == (ours.task_id, ours.success) == (name, True)
    states.take()
    moved = arm.newest(states)
    np.testing.assert_allclose(moved.joint_positions[:6], arm.joints, atol=0.01)
    assert moved.stamp.sec > 0
    assert np.abs(moved.joint_positions[:6] - start).max() > 0.1


def test_a_trajectory_of_a_real_node_moves_the_arm_and_the_controller_says_so(arm: Side) -> None:
    states = arm.node.subscription(articles.CONTROLLER_TOPIC, articles.CONTROLLER)
    goal = arm.joints + 0.1
    names = [f"{name}_joint" for name in ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")]
    values = {"joint_names": names, "points": [{"positions": goal.tolist(), "time_from_start": {"sec": 2}}]}
    message = "trajectory_msgs/msg/JointTrajectory", json.dumps(values)
    with Peer("topic.py", "pub", articles.TRAJECTORY_TOPIC, *message, "--hz=0.5", domain=domain_of(arm)):
        until(lambda: np.abs(arm.joints - goal).max() < 0.01, "the arm is there")
    states.take()
    state = arm.newest(states)
    assert state.joint_names == names
    np.testing.assert_allclose(state.feedback.positions, goal, atol=0.02)
    np.testing.assert_allclose(state.error.positions, state.reference.positions - state.feedback.positions, atol=1e-9)
    arm.send(articles.TRAJECTORY_TOPIC, message[0], {"joint_names": names})
    arm.served.wait_for(f"refused 1: {articles.TRAJECTORY_TOPIC}: the trajectory has no point")


def test_twists_of_a_real_node_drive_a_base_by_the_articles_topic(tmp_path: Path) -> None:
    for base in served("turtlebot3", tmp_path, "--robot.arena=empty", "--articles=true"):
        message = "geometry_msgs/msg/Twist", json.dumps({"linear": {"x": 0.1}})
        with Peer("topic.py", "pub", articles.TWIST_TOPIC, *message, domain=domain_of(base)):
            base.wait(lambda state: state.is_moving, "it drives")
        base.wait(lambda state: not state.is_moving, "it stands")


@pytest.mark.parametrize(
    ("messages", "xml", "error"),
    [
        (MESSAGES, "", "is no package of messages"),
        (MESSAGES, "<package", "is no package of messages"),
        (MESSAGES, "<package><name>A b</name></package>", "names the package 'A b'"),
        ({}, XML.replace(PACKAGE, "bare"), "there are none"),
        ({"Command": MESSAGES["BrainCommand"]}, XML.replace(PACKAGE, "half"), "is the result, which has the fields"),
        ({"Command": "string"}, XML.replace(PACKAGE, "wrong"), "The definition of wrong/msg/Command cannot be read"),
        *[
            (
                MESSAGES | {name: MESSAGES[name].replace(right, wrong)},
                XML.replace(PACKAGE, package),
                rf"\b{field} of its message {name}, the .*, is {kind}; it is ",
            )
            for package, name, right, wrong, field, kind in (
                ("numbered", "BrainCommand", "string task_id", "uint64 task_id", "task_id", "uint64"),
                (
                    "placed",
                    "BrainCommand",
                    "geometry_msgs/PoseStamped",
                    "geometry_msgs/Point",
                    "target_pose",
                    ".*Point",
                ),
                ("coded", "TaskResult", "string message", "int32 message", "message", "int32"),
                ("fixed", "CerebellumState", "[] joint_pos", "[6] joint_pos", "joint_positions", r"float64\[6\]"),
            )
        ],
    ],
)
def test_a_package_that_is_none_is_named(messages: dict[str, str], xml: str, error: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=error):
        articles.article_names(str(package(tmp_path / "src", messages, xml)))
