"""The planned path of an arm's tool and the path of a base, as messages."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bhd_lerobot.control.commands import BrainCommand, Feedback, GoalPhase
from bhd_lerobot.control.geometry.poses import pose_vectors
from bhd_lerobot.control.motion.planner import GoalPlanner, Plan
from bhd_lerobot.control.motion.trajectory import Trajectory
from bhd_lerobot.ros2.messages.serialize import decode
from bhd_lerobot.ros2.serve.paths import DRIVEN_TOPIC, GOAL_TOPIC, PLAN_TOPIC, DrivenPath, PlannedPath
from bhd_lerobot.ros2.serve.server import State
from bhd_lerobot.ros2.serve.trajectory import JointTrajectory
from tests.control.goal_rig import ARM, HOME, HZ, KINEMATICS, joints, moved

NAMES = [f"{joint}_joint" for joint in ARM.arm.chain.joints]


class Node:
    """Keeps what is sent, by topic."""

    def __init__(self) -> None:
        self.sent: dict[str, list[Any]] = {}
        self.receivers = 1

    def publisher(self, topic: str, msgtype: str, *_: Any) -> Any:
        node, sent = self, self.sent.setdefault(topic, [])

        class Publisher:
            @property
            def receivers(self) -> int:
                return node.receivers

            def send(self, data: bytes) -> None:
                sent.append(decode(msgtype, data))

        return Publisher()


class Robot:
    """An arm whose planner and cerebellum say what a test says."""

    body = ARM
    config = SimpleNamespace(type="ur5")

    def __init__(self) -> None:
        self.planner = SimpleNamespace(newest=None)
        self.phase: GoalPhase | None = None
        self.link = SimpleNamespace(planner=self.planner)
        self.bridge = self

    def feedback(self) -> Feedback | None:
        return None if self.phase is None else Feedback("a", self.phase, 0.0, 0.0, 0.0)


def positions(poses: Any) -> np.ndarray:
    return np.array([[getattr(one.pose.position, axis) for axis in "xyz"] for one in poses])


def vector(pose: Any) -> np.ndarray:
    place, turn = pose.position, pose.orientation
    return np.array([place.x, place.y, place.z, turn.w, turn.x, turn.y, turn.z])


def tool(posture: Any) -> np.ndarray:
    return np.asarray(pose_vectors(KINEMATICS.tool(np.asarray(posture)[:6])))


def plan(command: BrainCommand) -> Trajectory:
    made = GoalPlanner(ARM, HZ).plan(command, HOME, 0 * HOME, 0 * HOME)
    assert isinstance(made, Plan)
    return made.trajectory


STATE = State(None, 1_500_000_000, None)


@pytest.mark.parametrize(
    "command",
    [
        BrainCommand("line", target_pose=moved(0.05, dz=-0.1), motion="line"),
        BrainCommand("pose", target_pose=moved(0.05)),
        BrainCommand("joints", joint_target=joints(0.3)),
        BrainCommand("gripper alone", gripper=0.0),
    ],
)
def test_the_path_is_the_tools_from_here_to_the_goal_while_the_goal_is_followed(command: BrainCommand) -> None:
    robot, node, trajectory = Robot(), Node(), plan(command)
    host: Any = robot
    part = PlannedPath(host, node, lambda: None)  # type: ignore[arg-type]
    [output] = part.outputs
    robot.planner.newest = trajectory
    for phase in (None, GoalPhase.CONVERTING, GoalPhase.ERROR):
        robot.phase = phase
        output.publish(STATE)
    assert node.sent == {PLAN_TOPIC: [], GOAL_TOPIC: []}

    robot.phase = GoalPhase.EXECUTING
    for _ in range(3):
        output.publish(STATE)
    [path], [goal] = node.sent[PLAN_TOPIC], node.sent[GOAL_TOPIC]  # once
    assert path.header.frame_id == goal.header.frame_id == "base"
    assert (path.header.stamp.sec, path.header.stamp.nanosec) == (1, 500_000_000)
    assert 1 <= len(path.poses) <= 100
    assert vector(path.poses[0].pose) == pytest.approx(tool(trajectory.position[0]), abs=1e-12)
    assert vector(path.poses[-1].pose) == pytest.approx(tool(trajectory.position[-1]), abs=1e-12)
    assert vector(goal.pose) == pytest.approx(vector(path.poses[-1].pose))
    if command.target_pose is not None:
        assert vector(goal.pose)[:3] == pytest.approx(np.array(command.target_pose.position), abs=1e-6)
    if command.motion == "line":
        points = positions(path.poses)
        way = points[-1] - points[0]
        assert np.abs(np.cross(points - points[0], way / np.linalg.norm(way))).max() < 1e-6

    robot.phase = GoalPhase.IDLE
    for _ in range(3):
        output.publish(STATE)
    assert [len(one.poses) for one in node.sent[PLAN_TOPIC][1:]] == [0]
    assert len(node.sent[GOAL_TOPIC]) == 1

    robot.phase = GoalPhase.EXECUTING
    robot.planner.newest = plan(command)  # the next goal, of the same kind
    output.publish(STATE)
    assert len(node.sent[GOAL_TOPIC]) == 2


def test_a_joint_trajectory_of_the_topic_has_a_path_too() -> None:
    at_end = SimpleNamespace(sec=2, nanosec=0)
    point = SimpleNamespace(
        positions=list(joints(0.3)), velocities=[], accelerations=[], effort=[], time_from_start=at_end
    )
    followed: list[JointTrajectory | None] = [
        JointTrajectory(SimpleNamespace(joint_names=NAMES, points=[point]), NAMES, HOME[:6])
    ]
    host: Any = Robot()
    node: Any = Node()
    [output] = PlannedPath(host, node, lambda: followed[0]).outputs
    output.publish(STATE)
    [path], [goal] = node.sent[PLAN_TOPIC], node.sent[GOAL_TOPIC]
    assert vector(path.poses[0].pose) == pytest.approx(tool(HOME), abs=1e-12)
    assert vector(path.poses[50].pose) == pytest.approx(tool(HOME[:6] + 50 / 99 * (np.array(joints(0.3)) - HOME[:6])))
    assert vector(path.poses[-1].pose) == pytest.approx(tool(joints(0.3)), abs=1e-12)
    assert vector(goal.pose) == pytest.approx(tool(joints(0.3)), abs=1e-12)
    followed[0] = None
    output.publish(STATE)
    assert not node.sent[PLAN_TOPIC][-1].poses


def test_the_path_of_a_base_is_that_of_the_last_minute_and_is_made_where_somebody_receives_it() -> None:
    node: Any = Node()
    node.receivers = 0
    [output] = DrivenPath(node).outputs
    assert output.rate_hz == 5
    for k in range(400):
        if k == 399:
            node.receivers = 1
        base: Any = SimpleNamespace(odometry=np.array([[0.1 * k, -0.2 * k, 0.01 * k]]))
        output.publish(State(None, k * 200_000_000, base))
    [path] = node.sent[DRIVEN_TOPIC]
    assert path.header.frame_id == "odom"
    assert len(path.poses) == 300  # 60 s at 5 Hz
    expected = np.arange(100, 400)[:, None] * np.array([0.1, -0.2, 0.0])
    assert positions(path.poses) == pytest.approx(expected)
    first, last = path.poses[0], path.poses[-1]
    assert (first.header.stamp.sec, last.header.stamp.sec, last.header.stamp.nanosec) == (20, 79, 800_000_000)
    assert (last.pose.orientation.w, last.pose.orientation.z) == pytest.approx((np.cos(3.99 / 2), np.sin(3.99 / 2)))
