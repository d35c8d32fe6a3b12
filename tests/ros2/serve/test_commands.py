"""What becomes of commands to a served robot: none is lost, a refused one changes nothing, what is cut is said."""

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from bhd_lerobot.ros2.live.network import EVERY, NetworkConfig, Qos
from bhd_lerobot.ros2.live.node import Node, Publisher, Subscription
from bhd_lerobot.ros2.messages import ur
from bhd_lerobot.ros2.messages.serialize import encode
from bhd_lerobot.ros2.serve.interface import COMMAND, COMMAND_TOPIC, ESTOP_TOPIC, RESET_TOPIC, RESULT, RESULT_TOPIC
from tests.ros2.peer_env import free_domain
from tests.ros2.programs import Served
from tests.waiting import until

BOOL, STATE = "std_msgs/msg/Bool", "bhd_interfaces/msg/CerebellumState"
JOINTS = [f"{name}_joint" for name in ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")]


class Side:
    """Another node, and the robot that it commands."""

    def __init__(self, served: Served, node: Node) -> None:
        self.served, self.node = served, node
        self.states = node.subscription("/cerebellum/state", STATE)
        self.results = node.subscription(RESULT_TOPIC, RESULT, EVERY)
        self.diagnostics = node.subscription("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")
        self._publishers: dict[str, Publisher] = {}

    def publisher(self, topic: str, msgtype: str) -> Publisher:
        if topic not in self._publishers:
            self._publishers[topic] = self.node.publisher(topic, msgtype, EVERY)
        publisher = self._publishers[topic]
        until(lambda: publisher.receivers, f"the robot receives {topic}")
        return publisher

    def send(self, topic: str, msgtype: str, fields: dict[str, Any]) -> None:
        self.publisher(topic, msgtype).send(encode(msgtype, fields, 1)[0])

    def newest(self, subscription: Subscription | None = None) -> Any:
        return until((subscription or self.states).take, "a message comes")[-1].message()

    def state(self) -> Any:
        self.states.take()
        return self.newest()

    @property
    def joints(self) -> NDArray[np.float64]:
        return np.asarray(self.state().joint_positions)[:6]

    def wait(self, holds: Callable[[Any], Any], text: str) -> None:
        until(lambda: holds(self.state()), text)

    def ended(self, count: int) -> list[Any]:
        found: list[Any] = []
        until(lambda: [found.extend(one.message() for one in self.results.take()), len(found) >= count][1], "results")
        return found

    def reset(self) -> None:
        self.send(RESET_TOPIC, "std_msgs/msg/Empty", {})
        self.wait(lambda state: not state.emergency_stop, "the robot is reset")


def served(robot: str, folder: Path, *options: str) -> Iterator[Side]:
    with (
        free_domain() as domain,
        Served(robot, *options, domain=domain, log=folder / "log") as program,
        Node("other", NetworkConfig(domain=domain)) as node,
    ):
        yield Side(program, node)


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Side]:
    yield from served("turtlebot3", tmp_path_factory.mktemp("base"), "--robot.arena=empty")


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Side]:
    yield from served("ur5", tmp_path_factory.mktemp("arm"))


@pytest.mark.parametrize(
    "values",
    [[True] + [False] * 11, [False] * 500 + [True] + [False] * 3000, [True] * 20 + [False] * 20],
    ids=["followed", "inside", "many"],
)
def test_a_press_among_any_number_of_messages_presses(values: list[bool], base: Side) -> None:
    publisher = base.publisher(ESTOP_TOPIC, BOOL)
    data = {value: encode(BOOL, {"data": value}, 1)[0] for value in (False, True)}
    for value in values:
        publisher.send(data[value])
    base.wait(lambda state: state.emergency_stop, "the stop is latched")
    base.reset()


def test_a_best_effort_publisher_presses_and_is_no_mismatch(base: Side) -> None:
    publisher = base.node.publisher(ESTOP_TOPIC, BOOL, Qos(1, reliable=False))
    [data] = encode(BOOL, {"data": True}, 1)
    # What is sent before both sides have found each other is lost: a button publishes as long as it is pressed.
    base.wait(lambda state: state.emergency_stop or publisher.send(data), "the stop is latched")
    base.reset()
    assert "best effort" not in base.served.text


def goal(name: str, x: float) -> dict[str, Any]:
    pose = {"position": {"x": x}, "orientation": {"w": 1.0}}
    return {"header": {"frame_id": "odom"}, "task_id": name, "target_pose": pose}


def test_each_goal_of_a_burst_has_one_result(base: Side) -> None:
    names = [f"burst {k}" for k in range(100)]
    for name in names:
        base.send(COMMAND_TOPIC, COMMAND, goal(name, 0.05))
    base.send(COMMAND_TOPIC, COMMAND, goal("", 0.0))
    assert sorted(one.task_id for one in base.ended(101)) == sorted(["", *names])


def test_each_goal_of_a_burst_to_an_arm_has_one_result(arm: Side) -> None:
    # Near where the arm stands; the first is followed, eight wait, and the others are refused.
    pose = {"position": {"x": 0.5, "y": 0.1, "z": 0.4}, "orientation": {"y": 1.0, "w": 0.0}}
    names = [f"burst {k}" for k in range(100)]
    for name in names:
        arm.send(COMMAND_TOPIC, COMMAND, {"header": {"frame_id": "base"}, "task_id": name, "target_pose": pose})
    ended = arm.ended(100)
    assert sorted(one.task_id for one in ended) == sorted(names)
    assert any("goals wait already" in one.message for one in ended)
    is_at(arm, arm.joints)


def test_a_refused_twist_leaves_the_goal_alone(base: Side) -> None:
    twist = "geometry_msgs/msg/TwistStamped"
    base.send(COMMAND_TOPIC, COMMAND, goal("the goal", -0.4))
    for value in (np.nan, np.inf):
        base.send("/cmd_vel", twist, {"twist": {"linear": {"x": value}}})
    [result] = base.ended(1)
    assert (result.task_id, result.success) == ("the goal", True)
    base.send(COMMAND_TOPIC, COMMAND, goal("another", 0.4))
    base.wait(lambda state: state.is_moving, "it drives")
    base.send("/cmd_vel", twist, {"twist": {"linear": {"x": 0.0}}})
    [result] = base.ended(1)
    assert (result.task_id, result.success) == ("another", False)


def trajectory(arm: Side, positions: NDArray[np.float64], ahead_s: float | None = None, **point: Any) -> None:
    stamp = 0 if ahead_s is None else time.time_ns() + round(ahead_s * 1e9)
    parts = {"sec": np.array([stamp // 10**9]), "nanosec": np.array([stamp % 10**9])}
    last = {"positions": positions[None], "time_from_start": {"sec": np.array([1])}, **point}
    arm.send(ur.TRAJECTORY_TOPIC, ur.TRAJECTORY, {"header": {"stamp": parts}, "joint_names": JOINTS, "points": [last]})


def joint(number: int, angle: float) -> NDArray[np.float64]:
    return angle * np.eye(6)[number]


def is_at(arm: Side, positions: NDArray[np.float64]) -> None:
    arm.wait(lambda state: np.abs(np.asarray(state.joint_positions)[:6] - positions).max() < 0.01, "it arrives")


def test_a_stamp_is_the_start_of_a_trajectory(arm: Side) -> None:
    home = arm.joints
    trajectory(arm, home + 0.1, -10.0)
    arm.served.wait_for("by its stamp the trajectory ended 9")
    trajectory(arm, home + 0.1, 3.0)
    arm.served.wait_for("by its stamp the trajectory starts in")
    begin = time.monotonic()
    np.testing.assert_allclose(arm.joints, home, atol=0.03)
    assert time.monotonic() - begin < 2.0, "the machine was too slow to see that it waits"
    is_at(arm, home + 0.1)
    trajectory(arm, home, -0.3)  # the rest of one that began already
    is_at(arm, home)


def test_a_trajectory_that_waits_does_not_outlive_an_emergency_stop(arm: Side) -> None:
    home = arm.joints
    trajectory(arm, home + 0.1, 1.5)
    arm.send(ESTOP_TOPIC, BOOL, {"data": True})
    arm.served.wait_for("the arm was stopped before the trajectory's start")
    arm.reset()
    time.sleep(2.0)
    np.testing.assert_allclose(arm.joints, home, atol=0.03)


def test_one_message_of_positions_is_followed_to_its_end(arm: Side) -> None:
    home = arm.joints
    for target in (home + joint(0, 1.0), home):
        arm.send(ur.POSITION_TOPIC, ur.FLOATS, {"data": target[None]})
        is_at(arm, target)
    arm.send(ur.POSITION_TOPIC, ur.FLOATS, {"data": (home + joint(0, 0.5))[None]})
    for refused in (home[None, :5], np.full((1, 6), np.nan)):
        arm.send(ur.POSITION_TOPIC, ur.FLOATS, {"data": refused})
    is_at(arm, home + joint(0, 0.5))
    trajectory(arm, home)
    is_at(arm, home)


def test_what_the_limits_cut_is_printed_and_published(arm: Side) -> None:
    home = arm.joints
    trajectory(arm, home + joint(1, 1.2))  # into the table
    arm.served.wait_for("the arm holds short of the last position of shoulder_lift_joint")
    arm.served.wait_for("by the robot's limit of clearance")
    until(lambda: "limit of clearance" in str(arm.newest(arm.diagnostics)), "it is published")
    trajectory(arm, home)
    is_at(arm, home)


def test_a_second_robot_in_the_domain_is_named(base: Side, tmp_path: Path) -> None:
    domain = base.node.network.domain_number
    with Served("turtlebot3", "--robot.arena=empty", domain=domain, log=tmp_path / "log") as second:
        for robot in (second, base.served):
            robot.wait_for("Another node, /turtlebot3, subscribes to /brain/command, /cmd_vel, /emergency_stop")
