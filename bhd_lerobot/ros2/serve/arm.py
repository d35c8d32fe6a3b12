"""The topics of a UR5, as `ur_robot_driver` and `robot_state_publisher` have them.

Different from the real ones: the gripper has a topic here, both command topics work without switching controllers, and
the joints' efforts are torques [N m], where the driver publishes the motors' currents [A].
"""

import time
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Arm
from bhd_lerobot.control.messages import NANOSECONDS
from bhd_lerobot.errors import ActionError
from bhd_lerobot.robots.host.realtime import LiveHost
from bhd_lerobot.ros2.live.network import LATCHED, Qos
from bhd_lerobot.ros2.live.node import Node
from bhd_lerobot.ros2.messages import ur, views
from bhd_lerobot.ros2.messages.parts import Frames, header
from bhd_lerobot.ros2.messages.serialize import encode
from bhd_lerobot.ros2.serve.server import NEVER_NS, Counts, Input, Output, State
from bhd_lerobot.ros2.serve.trajectory import JointTrajectory

JOINT_STATES_HZ = 125  # of a UR5 (CB3); a UR5e has 500
_TRANSFORMS_HZ = 50
_SPEED_SCALING_HZ = 100


class ArmTopics:
    """The topics of an arm.

    Args:
        host: the robot, whose actions are joint positions.
        node: the node.
        counts: what is refused.
        view: what is known of the robot.
        joint_states_hz: how often the joints are published [Hz].
    """

    def __init__(
        self, host: LiveHost, node: Node, counts: Counts, view: views.RobotView, joint_states_hz: float
    ) -> None:
        body = host.body
        if not isinstance(body, Arm):
            raise AssertionError(f"{host.config.type} is no arm.")
        self._host, self._counts, self._view, self._rate_hz = host, counts, view, joint_states_hz
        self._names = [f"{joint}_joint" for joint in body.chain.joints]
        self._count = len(self._names)
        self._command: NDArray[np.float64] = host.bridge.latest["command"].copy()  # joints, then the gripper
        self._trajectory: tuple[JointTrajectory, int] | None = None
        self._period_ns = NANOSECONDS // host.rates.fps
        self._sent_ns = 0
        self._joint_states = node.publisher("/joint_states", views.JOINT_STATE)
        self._scaling = node.publisher(ur.SCALING_TOPIC, ur.FLOAT)
        self._transforms = node.publisher("/tf", views.TF, Qos(100))
        self._static = node.publisher("/tf_static", views.TF, LATCHED)
        self._inputs = [
            Input(node.subscription(ur.TRAJECTORY_TOPIC, ur.TRAJECTORY), self._follow),
            Input(node.subscription(ur.POSITION_TOPIC, ur.FLOATS), self._move),
            Input(node.subscription(ur.GRIPPER_TOPIC, ur.FLOATS), self._grip),
        ]
        [self._full_speed] = encode(ur.FLOAT, {"data": 100.0}, 1)
        for message in views.static_transforms(view.frames, State.of(host).stamp_ns):
            self._static.send(message)

    def outputs(self) -> Iterable[Output]:
        """Return what is published."""
        return [
            Output(self._rate_hz, self._publish),
            Output(_TRANSFORMS_HZ, self._publish_transforms),
            Output(_SPEED_SCALING_HZ, lambda _: self._scaling.send(self._full_speed)),
        ]

    def inputs(self) -> Iterable[Input]:
        """Return what commands the robot."""
        return self._inputs

    def trajectory(self) -> JointTrajectory | None:
        """Return the joint trajectory that is followed, or None."""
        return self._trajectory[0] if self._trajectory is not None else None

    def _publish(self, state: State) -> None:
        record, count = state.record, self._count
        fields = {
            "header": header(state.stamps, "base_link"),
            "name": self._names,
            "position": record["joint_positions"][:, :count],
            "velocity": record["joint_velocities"][:, :count],
            "effort": record["joint_efforts"][:, :count],
        }
        self._joint_states.send(encode(views.JOINT_STATE, fields, 1)[0])

    def _publish_transforms(self, state: State) -> None:
        angles = state.record["joint_positions"][0]
        motion = views.Motion({name: angles[k : k + 1] for k, name in enumerate(self._names)})
        frames = Frames(0, np.zeros(1, np.int64), state.stamps)
        for message in views.moving_transforms(self._view, frames, motion):
            self._transforms.send(message)

    # --- commands ----------------------------------------------------------------------------------------------------

    def _follow(self, message: Any) -> None:
        start = self._host.bridge.latest["command"][0, : self._count]
        try:
            self._trajectory = JointTrajectory(message, self._names, start), time.monotonic_ns()
        except ActionError as error:
            self._counts.add(f"{ur.TRAJECTORY_TOPIC}: {error}")

    def _move(self, message: Any) -> None:
        if len(message.data) != self._count:
            self._counts.add(f"{ur.POSITION_TOPIC}: {len(message.data)} positions; there are {self._count} joints")
            return
        self._trajectory = None
        self._send(ur.POSITION_TOPIC, np.asarray(message.data, np.float64))

    def _grip(self, message: Any) -> None:
        if len(message.data) != 1:
            self._counts.add(f"{ur.GRIPPER_TOPIC}: {len(message.data)} values; it takes the opening [m] alone")
            return
        before = self._command[0, self._count]
        self._command[0, self._count] = message.data[0]
        if not self._send(ur.GRIPPER_TOPIC, self._host.bridge.latest["command"][0, : self._count]):
            self._command[0, self._count] = before

    def _send(self, topic: str, joints: NDArray[np.float64]) -> bool:
        self._command[0, : self._count] = joints
        sent = self._host.bridge.send(self._command)
        self._counts.add_result(topic, sent)
        return not sent.reasons[0]

    def poll(self, now_ns: int) -> int:
        """Send the present setpoint of a trajectory; return when the next one is due [ns]."""
        if self._trajectory is None:
            return NEVER_NS
        if now_ns < self._sent_ns + self._period_ns:
            return self._sent_ns + self._period_ns
        trajectory, start_ns = self._trajectory
        time_s = (now_ns - start_ns) / NANOSECONDS
        self._sent_ns = now_ns
        if not self._send(ur.TRAJECTORY_TOPIC, trajectory.at(time_s)) or time_s >= trajectory.duration_s:
            self._trajectory = None
            return NEVER_NS
        return now_ns + self._period_ns
