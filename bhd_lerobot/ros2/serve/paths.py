"""Paths for viewers: where an arm's tool is going to move, and where a base has driven."""

from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Arm
from bhd_lerobot.control.commands import GoalPhase
from bhd_lerobot.control.geometry.forward_kinematics import ForwardKinematics
from bhd_lerobot.control.geometry.poses import pose_vectors
from bhd_lerobot.robots.host.realtime import LiveHost
from bhd_lerobot.ros2.live.network import LATCHED
from bhd_lerobot.ros2.live.node import Node
from bhd_lerobot.ros2.messages.parts import header
from bhd_lerobot.ros2.messages.serialize import decode, encode
from bhd_lerobot.ros2.messages.table import ARM_FRAME, ODOM_FRAME
from bhd_lerobot.ros2.messages.types import type_store
from bhd_lerobot.ros2.serve.server import Output, State, Topics
from bhd_lerobot.ros2.serve.trajectory import JointTrajectory

PATH, POSE = "nav_msgs/msg/Path", "geometry_msgs/msg/PoseStamped"
PLAN_TOPIC, GOAL_TOPIC, DRIVEN_TOPIC = "/cerebellum/plan", "/cerebellum/goal", "/cerebellum/path"
_PLAN_HZ = 10  # how often a new plan is looked for
_PLAN_POINTS = 100  # of the longest plan
_DRIVEN_HZ, _DRIVEN_S = 5, 60


class PlannedPath(Topics):
    """The path of an arm's tool by the plan that is followed, and its end, in the base frame.

    The plan is that of a goal, or a joint trajectory that came by its topic. At its end the path is empty.
    """

    def __init__(self, host: LiveHost, node: Node, trajectory: Callable[[], JointTrajectory | None]) -> None:
        planner, chain = host.link.planner, host.body.need(Arm).chain
        if planner is None:
            raise AssertionError(f"{host.config.type} is no arm.")
        self._host, self._planner, self._trajectory = host, planner, trajectory
        self._kinematics, self._dof = ForwardKinematics(chain), len(chain.joints)
        self._shown: Any = None  # the plan that was published last
        self._path = node.publisher(PLAN_TOPIC, PATH, LATCHED)
        self._goal = node.publisher(GOAL_TOPIC, POSE, LATCHED)
        self.outputs = [Output(_PLAN_HZ, self._publish)]

    def _publish(self, state: State) -> None:
        followed: Any = self._trajectory()
        if followed is None:
            feedback = self._host.bridge.feedback()
            is_executing = feedback is not None and feedback.phase == GoalPhase.EXECUTING
            followed = self._planner.newest if is_executing else None
        if followed is self._shown:
            return
        self._shown = followed
        poses: NDArray[np.float64] = np.empty((0, 7))
        if followed is not None:
            poses = pose_vectors(self._kinematics.tool(self._postures(followed)))
            self._goal.send(_poses(state.stamps, ARM_FRAME, poses[-1:])[0])
        way = [decode(POSE, one) for one in _poses(state.stamps, ARM_FRAME, poses)]
        self._path.send(_path(state.stamps, ARM_FRAME, way))

    def _postures(self, followed: Any) -> NDArray[np.float64]:
        """Return joint positions along a plan [rad], shape (points, dof)."""
        if isinstance(followed, JointTrajectory):
            return np.stack([followed.at(time_s) for time_s in np.linspace(0.0, followed.duration_s, _PLAN_POINTS)])
        rows = np.linspace(0, followed.ticks - 1, min(followed.ticks, _PLAN_POINTS)).round().astype(np.intp)
        return followed.position[rows, : self._dof]


class DrivenPath(Topics):
    """The path that a base has driven in the last minute, by its odometry; sent where somebody receives it."""

    def __init__(self, node: Node) -> None:
        self._poses: deque[Any] = deque(maxlen=_DRIVEN_HZ * _DRIVEN_S)
        self._path = node.publisher(DRIVEN_TOPIC, PATH)
        self.outputs = [Output(_DRIVEN_HZ, self._publish)]

    def _publish(self, state: State) -> None:
        x, y, yaw = state.robot.odometry[0]
        [pose] = _poses(state.stamps, ODOM_FRAME, np.array([[x, y, 0.0, np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)]]))
        self._poses.append(decode(POSE, pose))
        if self._path.receivers:
            self._path.send(_path(state.stamps, ODOM_FRAME, list(self._poses)))


def _poses(stamps: NDArray[np.int64], frame: str, poses: NDArray[np.float64]) -> list[bytes]:
    """Return messages of poses, shape (n, 7), that share a stamp."""
    fields = {"header": header(stamps.repeat(len(poses)), frame), "pose": _pose_tree(poses)}
    return encode(POSE, fields, len(poses))


def _path(stamps: NDArray[np.int64], frame: str, poses: list[Any]) -> bytes:
    """Return a path of poses that are messages: only what is new has to be made of numbers."""
    empty = decode(PATH, encode(PATH, {"header": header(stamps, frame)}, 1)[0])
    empty.poses = poses
    return bytes(type_store().serialize_cdr(empty, PATH))


def _pose_tree(values: NDArray[np.float64]) -> dict[str, Any]:
    """Return `geometry_msgs/msg/Pose` of positions and quaternions wxyz, shape (n, 7)."""
    return {
        "position": dict(zip("xyz", values[:, :3].T, strict=True)),
        "orientation": dict(zip("wxyz", values[:, 3:].T, strict=True)),
    }
