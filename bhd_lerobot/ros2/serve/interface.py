"""What a brain in another process exchanges with the robot: commands, results, the state, the emergency stop."""

import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, override

from bhd_lerobot.control.commands import BrainCommand, CommandResult, Pose, ResultCode
from bhd_lerobot.control.messages import Limit
from bhd_lerobot.robots.host.realtime import LiveHost
from bhd_lerobot.robots.host.state import LIMITS
from bhd_lerobot.ros2.live.network import EVERY, Qos
from bhd_lerobot.ros2.live.node import Node
from bhd_lerobot.ros2.messages.parts import header, stamp_tree
from bhd_lerobot.ros2.messages.serialize import encode, encode_known
from bhd_lerobot.ros2.messages.types import INTERFACES
from bhd_lerobot.ros2.serve.goals import Goals
from bhd_lerobot.ros2.serve.server import Counts, Input, Output, State, Topics, for_nodes

COMMAND, RESULT, STATE = (f"{INTERFACES}/msg/{name}" for name in ("BrainCommand", "BrainResult", "CerebellumState"))
COMMAND_TOPIC, RESULT_TOPIC, STATE_TOPIC = "/brain/command", "/brain/result", "/cerebellum/state"
ESTOP_TOPIC, RESET_TOPIC = "/emergency_stop", "/emergency_stop/reset"
BOOL, LOSSY = "std_msgs/msg/Bool", Qos(0, reliable=False)
DIAGNOSTICS_TOPIC, DIAGNOSTICS = "/diagnostics", "diagnostic_msgs/msg/DiagnosticArray"
_RESULTS_HZ, _DIAGNOSTICS_HZ = 50, 1
_CUTS = Limit.NON_FINITE | Limit.VELOCITY | Limit.POSITION | Limit.POSTURE | Limit.CLEARANCE  # others are of every day
_LAST_S = 0.5  # that others may take to receive the last results
_MOST_RESULTS = 1000  # that wait to be sent; commands wait until there are fewer
_RESULTS_AT_ONCE = 5  # half of what a ROS 2 subscription keeps by default


@dataclass(frozen=True)
class Names:
    """Under which topics, and as which messages, goals, their results and the state are exchanged.

    Fields of a message are found by their names; a field that the other side does not have is left out.
    """

    command: str = COMMAND_TOPIC
    result: str = RESULT_TOPIC
    state: str = STATE_TOPIC
    command_type: str = COMMAND
    result_type: str = RESULT
    state_type: str = STATE


class InterfaceTopics(Topics):
    """The topics of brain and cerebellum.

    Args:
        ended: called with the result of each goal that was taken, before it is published.
    """

    def __init__(
        self,
        host: LiveHost,
        node: Node,
        counts: Counts,
        state_hz: float,
        goals: Goals,
        *,
        taken: Callable[[], None] = lambda: None,
        ended: Callable[[CommandResult], None] = lambda result: None,
        names: Sequence[Names] = (Names(),),
    ) -> None:
        self._host, self._counts, self._goals, self._taken = host, counts, goals, taken
        self._frame, self._ended = goals.frames[0], ended
        self._results_out = [(node.publisher(one.result, one.result_type, Qos(1000)), one.result_type) for one in names]
        self._states_out = [(node.publisher(one.state, one.state_type), one.state_type) for one in names]
        self._diagnostics = node.publisher(DIAGNOSTICS_TOPIC, DIAGNOSTICS)
        self._limits, self._reported = host.bridge.latest["limits"].copy(), counts.all()
        self._results: deque[CommandResult] = deque()
        self._open: set[str] = set()  # goals that were taken and have not ended
        commands = dict.fromkeys((one.command, one.command_type) for one in names)
        # The stop comes after the reset: of two that arrive together the robot stays stopped. A publisher that is best
        # effort presses, too.
        self.inputs = [
            Input(node.subscription(RESET_TOPIC, "std_msgs/msg/Empty"), self._reset),
            *(Input(node.subscription(ESTOP_TOPIC, BOOL, qos), self._stop, "different") for qos in (EVERY, LOSSY)),
            *(Input(node.subscription(*one, EVERY), self._submit, "each", self._has_room) for one in commands),
        ]
        self.outputs = [
            Output(state_hz, self._publish),
            Output(_RESULTS_HZ, self._publish_results),
            Output(_DIAGNOSTICS_HZ, self._publish_diagnostics),
        ]

    def poll(self, now_ns: int) -> int:
        """Follow the goal; return when there is more to do [ns]."""
        return self._goals.poll(now_ns)

    @override
    def end(self) -> None:
        """Answer the goals that have not ended."""
        self._take_results()
        for name in self._open:
            self._results.append(CommandResult(name, False, ResultCode.CANCELLED, "The robot is no longer served."))
        while self._results:
            self._send_some()
            time.sleep(1 / _RESULTS_HZ)
        for publisher, _ in self._results_out:
            publisher.wait_for_acks(_LAST_S)

    def _has_room(self) -> bool:
        return len(self._results) < _MOST_RESULTS

    def _stop(self, message: Any) -> None:
        if message.data:
            self._host.estop()

    def _reset(self, message: Any) -> None:
        for request in (self._host.bridge.reset, self._host.bridge.activate):
            self._counts.add_result(RESET_TOPIC, request())

    def _submit(self, message: Any) -> None:
        target = message.target_pose  # of geometry_msgs: a Pose, or a PoseStamped
        stamped = target if hasattr(target, "header") else message
        frame = (stamped.header.frame_id if hasattr(stamped, "header") else "") or self._frame
        if frame not in self._goals.frames:
            text = f"The frame is {frame!r}; a target pose is in {' or '.join(map(repr, self._goals.frames))}."
            self._refuse(CommandResult(message.task_id, False, ResultCode.BAD_TARGET, text))
            return
        target = getattr(target, "pose", target)
        position, turn = target.position, target.orientation
        pose = Pose((position.x, position.y, position.z), (turn.w, turn.x, turn.y, turn.z))
        command = BrainCommand(
            message.task_id,
            target_pose=pose,
            max_velocity=getattr(message, "max_velocity", 0.0) or None,
            max_acceleration=getattr(message, "max_acceleration", 0.0) or None,
            timeout_s=self._goals.timeout_s,
        )
        refusal = self._goals.submit(command, frame)
        if refusal is None:
            self._open.add(command.task_id)
            self._taken()
        else:
            self._refuse(refusal)

    def _refuse(self, result: CommandResult) -> None:
        """Answer a goal that is refused, and count it by the kind of its cause, of which there are few."""
        self._counts.add(f"{COMMAND_TOPIC}: {result.code.name.lower().replace('_', ' ')}")
        self._results.append(result)

    def _publish_diagnostics(self, state: State) -> None:
        """Publish what was refused and what the robot's limits have changed; a warning where it happened just now."""
        more, self._limits = state.row["limits"] - self._limits, state.row["limits"].copy()
        for limit, count in zip(LIMITS, more.tolist(), strict=True):
            if count > 0 and limit in _CUTS:
                self._counts.note("cut", f"by the robot's limit of {str(limit.name).lower()}", count)
        found = self._counts.all()
        news = [
            f"{what}: {reason}"
            for (what, reason), count in found.items()
            if count != self._reported.get((what, reason))
        ]
        self._reported = found
        status = {
            "level": 1 if news else 0,
            "name": f"{self._host.config.type}: commands",
            "message": "; ".join(news) or "carried out",
            "values": [{"key": ": ".join(key), "value": str(count)} for key, count in found.items()],
        }
        self._diagnostics.send(encode(DIAGNOSTICS, {"header": header(state.stamps), "status": [status]}, 1)[0])

    def _take_results(self) -> None:
        for result in self._goals.take_results():
            self._open.discard(result.task_id)
            self._ended(result)
            self._results.append(result)

    def _publish_results(self, state: State) -> None:
        self._take_results()
        self._send_some()

    def _send_some(self) -> None:
        for _ in range(min(len(self._results), _RESULTS_AT_ONCE)):
            self._send(self._results.popleft())

    def _send(self, result: CommandResult) -> None:
        stamps = State.of(self._host).stamps
        fields = {
            "header": header(stamps),
            "stamp": stamp_tree(stamps),
            "task_id": result.task_id,
            "success": result.success,
            "message": for_nodes(result.message or result.code.name),
        }
        for publisher, msgtype in self._results_out:
            publisher.send(encode_known(msgtype, fields))

    def _publish(self, state: State) -> None:
        robot = state.robot
        fields = {
            "header": header(state.stamps, self._frame),
            "stamp": stamp_tree(state.stamps),
            "joint_positions": robot.joint_positions,
            "joint_velocities": robot.joint_velocities,
            "joint_efforts": robot.joint_efforts,
            "is_moving": bool(robot.is_moving[0]),
            "emergency_stop": bool(robot.emergency_stop[0]),
        }
        for publisher, msgtype in self._states_out:
            publisher.send(encode_known(msgtype, fields))
