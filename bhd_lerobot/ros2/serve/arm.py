"""The topics of a UR5, as `ur_robot_driver` and `robot_state_publisher` have them.

What differs from the real ones is in docs/how_to/ros2.md, "Differences".
"""

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Arm
from bhd_lerobot.control.messages import NANOSECONDS, Mode, Reason, mode_reason
from bhd_lerobot.errors import ActionError
from bhd_lerobot.robots.host.realtime import LiveHost
from bhd_lerobot.ros2.live.network import LATCHED, Qos
from bhd_lerobot.ros2.live.node import Node
from bhd_lerobot.ros2.messages import ur, views
from bhd_lerobot.ros2.messages.parts import header, header_stamps
from bhd_lerobot.ros2.messages.serialize import encode
from bhd_lerobot.ros2.messages.table import JOINTS
from bhd_lerobot.ros2.serve.server import NEVER_NS, Counts, Input, Output, State, Topics
from bhd_lerobot.ros2.serve.trajectory import JointTrajectory

_TRANSFORMS_HZ = 50
_SPEED_SCALING_HZ = 100
_REACHED = 1e-3  # [rad], and of the gripper [m]
_STUCK_NS = NANOSECONDS  # without coming nearer


class ArmTopics(Topics):
    """The topics of an arm."""

    def __init__(
        self, host: LiveHost, node: Node, counts: Counts, view: views.RobotView, joint_states_hz: float
    ) -> None:
        self._host, self._counts, self._view = host, counts, view
        self._names = [f"{joint}_joint" for joint in host.body.need(Arm).chain.joints]
        self._count = len(self._names)
        self._command: NDArray[np.float64] = host.bridge.state().command  # joints, then the gripper
        self._motion: _Motion | None = None  # what is followed
        self._next: tuple[Any, int, str] | None = None  # the trajectory that takes its place, when [ns], and its topic
        self._period_ns = NANOSECONDS // host.rates.fps
        self._sent_ns = 0
        self._joint_states = node.publisher("/joint_states", JOINTS)
        self._scaling = node.publisher(ur.SCALING_TOPIC, ur.FLOAT)
        self._transforms = node.publisher("/tf", views.TF, Qos(100))
        self._static = node.publisher("/tf_static", views.TF, LATCHED)
        commands: list[tuple[str, str, Callable[[Any], bool]]] = [
            (ur.TRAJECTORY_TOPIC, ur.TRAJECTORY, self.follow),
            (ur.POSITION_TOPIC, ur.FLOATS, self._move),
        ]
        if host.body.need(Arm).gripper is not None:
            commands.append((ur.GRIPPER_TOPIC, ur.FLOATS, self._grip))
        self.inputs = [Input(node.subscription(topic, msgtype), take) for topic, msgtype, take in commands]
        [full_speed] = encode(ur.FLOAT, {"data": 100.0}, 1)
        self.outputs = [
            Output(joint_states_hz, self._publish),
            Output(_TRANSFORMS_HZ, self._publish_transforms),
            Output(_SPEED_SCALING_HZ, lambda _: self._scaling.send(full_speed)),
        ]
        for message in views.static_transforms(view.frames, State.of(host).stamp_ns):
            self._static.send(message)

    def trajectory(self) -> JointTrajectory | None:
        """Return the joint trajectory that is followed, or None."""
        return self._motion.trajectory if self._motion is not None else None

    def interrupt(self) -> None:
        """End what is followed: a goal was taken, and the newer command counts."""
        self._motion = self._next = None

    def _publish(self, state: State) -> None:
        robot, count = state.robot, self._count
        fields = {
            "header": header(state.stamps, "base_link"),
            "name": self._names,
            "position": robot.joint_positions[:, :count],
            "velocity": robot.joint_velocities[:, :count],
            "effort": robot.joint_efforts[:, :count],
        }
        self._joint_states.send(encode(JOINTS, fields, 1)[0])

    def _publish_transforms(self, state: State) -> None:
        angles = state.robot.joint_positions[0]
        motion = views.Motion({name: angles[k : k + 1] for k, name in enumerate(self._names)})
        for message in views.moving_transforms(self._view, state.frames, motion):
            self._transforms.send(message)

    # --- commands ----------------------------------------------------------------------------------------------------

    def follow(self, message: Any, topic: str = ur.TRAJECTORY_TOPIC) -> bool:
        """Take a trajectory. Its stamp is its start, 0 is at once; until then what is followed goes on."""
        now = time.monotonic_ns()
        [stamp] = header_stamps([message]).tolist()
        start_ns = now + (stamp - time.time_ns() if stamp else 0)
        try:
            trajectory = self._trajectory(message, now - start_ns)
        except ActionError as error:
            return self._refuse(topic, str(error))
        if start_ns > now:
            self._next = message, start_ns, topic
            waits_s = (start_ns - now) / NANOSECONDS
            self._counts.note("waiting", f"{topic}: by its stamp the trajectory starts in {waits_s:.3g} s")
        else:
            self._motion, self._next = _Motion(topic, trajectory, start_ns), None
        return True

    def _refuse(self, topic: str, reason: str) -> bool:
        self._counts.add(f"{topic}: {reason}")
        return False

    def _trajectory(self, message: Any, passed_ns: int) -> JointTrajectory:
        start = self._host.bridge.state().command[0, : self._count]
        return JointTrajectory(message, self._names, start, max(0, passed_ns) / NANOSECONDS)

    def _move(self, message: Any) -> bool:
        if len(message.data) != self._count:
            reason = f"{len(message.data)} positions; there are {self._count} joints"
            return self._refuse(ur.POSITION_TOPIC, reason)
        if is_taken := self._send(ur.POSITION_TOPIC, np.asarray(message.data, np.float64)):
            self._motion, self._next = _Motion(ur.POSITION_TOPIC), None
        return is_taken

    def _grip(self, message: Any) -> bool:
        if len(message.data) != 1:
            return self._refuse(ur.GRIPPER_TOPIC, f"{len(message.data)} values; it takes the opening [m] alone")
        command = self._command if self._motion else self._host.bridge.state().command
        if is_taken := self._send(ur.GRIPPER_TOPIC, command[0, : self._count], message.data[0]):
            self._motion = self._motion or _Motion(ur.GRIPPER_TOPIC)
        return is_taken

    def _send(self, topic: str, joints: NDArray[np.float64], opening: float | None = None) -> bool:
        command = self._command.copy()
        command[0, : self._count] = joints
        if opening is not None:
            command[0, self._count] = opening
        sent = self._host.bridge.send(command)
        self._counts.add_result(topic, sent)
        if not sent.reasons[0]:
            self._command = command
        return not sent.reasons[0]

    def poll(self, now_ns: int) -> int:
        """Send the present setpoint of what is followed; return when the next one is due [ns]."""
        robot = self._host.bridge.state()
        if self._next is not None:
            message, start_ns, topic = self._next
            if mode_reason(Mode(int(robot.mode[0]))) != Reason.ACCEPTED:
                self._next = None
                self._counts.add(f"{topic}: the arm was stopped before the trajectory's start")
            elif now_ns >= start_ns:
                self._motion, self._next = _Motion(topic, self._trajectory(message, 0), start_ns), None
        following_ns = NEVER_NS if self._next is None else self._next[1]
        motion = self._motion
        if motion is None:
            return following_ns
        if now_ns >= self._sent_ns + self._period_ns:
            self._sent_ns = now_ns
            joints = (
                motion.trajectory.at(motion.time_s(now_ns)) if motion.trajectory else self._command[0, : self._count]
            )
            if not self._send(motion.topic, joints):
                self._motion = None
                return following_ns
            off = np.abs(robot.command - self._command)[0]
            if motion.is_over(now_ns, off):
                self._motion = None
                if off[: self._count].max() > _REACHED:
                    name = self._names[int(off[: self._count].argmax())]
                    self._counts.note("cut", f"{motion.topic}: the arm holds short of the last position of {name}")
                return following_ns
        return min(following_ns, self._sent_ns + self._period_ns)


class _Motion:
    """What an arm is brought to: sent again until the arm is there, as a controller of ROS 2 holds its last command.

    Args:
        trajectory: the joints' way; None for one posture.
    """

    def __init__(self, topic: str, trajectory: JointTrajectory | None = None, start_ns: int = 0) -> None:
        self.topic, self.trajectory, self._start_ns = topic, trajectory, start_ns
        self._nearest: Any = np.inf
        self._nearest_ns = 0

    def time_s(self, now_ns: int) -> float:
        """Return the time since the trajectory's start [s]."""
        return (now_ns - self._start_ns) / NANOSECONDS

    def is_over(self, now_ns: int, off: NDArray[np.float64]) -> bool:
        """Return whether the reference is at the end, or has come no nearer for a while; `off` is how far it is."""
        if self.trajectory and self.time_s(now_ns) < self.trajectory.duration_s:
            return False
        if off.sum() < self._nearest - _REACHED / 10:
            self._nearest, self._nearest_ns = off.sum(), now_ns
        return bool(off.max() <= _REACHED) or now_ns - self._nearest_ns > _STUCK_NS
