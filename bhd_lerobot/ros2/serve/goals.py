"""Pose goals of a brain in another process: an arm's cerebellum follows them; a base is driven to them."""

import math
from contextlib import suppress
from typing import override

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Drive
from bhd_lerobot.control.commands import BrainCommand, CommandResult, ResultCode
from bhd_lerobot.control.messages import NANOSECONDS, Mode, Reason
from bhd_lerobot.errors import DatasetError
from bhd_lerobot.policies.brain import Observation, RobotFeatures
from bhd_lerobot.policies.navigation.navigator import GOAL, NavigatorBrain, NavigatorConfig
from bhd_lerobot.robots.host.realtime import LiveHost
from bhd_lerobot.ros2.live.node import Subscription
from bhd_lerobot.ros2.messages.base import yaw_of
from bhd_lerobot.ros2.messages.table import ARM_FRAME, FOOTPRINT_FRAME, ODOM_FRAME
from bhd_lerobot.ros2.serve.server import NEVER_NS

_TOLERANCE_M, _TOLERANCE_RAD = 0.1, math.radians(10.0)  # as the task navigate has them
_REST, _REST_TURN = 0.03, 0.15  # [m/s], [rad/s], likewise
_LONGEST_S = 3600.0  # [s] however slow a goal is
_ONE = np.zeros(1, np.intp)


class Goals:
    """Follows one goal at a time.

    Attributes:
        frames: in which a target pose may be given; the first where none is named.
    """

    frames: tuple[str, ...]
    timeout_s: float

    def submit(self, command: BrainCommand, frame: str) -> CommandResult | None:
        """Take a goal; return the refusal, or None."""
        raise NotImplementedError

    def take_results(self) -> list[CommandResult]:
        """Return how goals ended, each once; not those that were refused."""
        raise NotImplementedError

    def interrupt(self) -> None:
        """End the goal: a setpoint has come, and the newer command counts. By default the cerebellum sees that."""

    def poll(self, now_ns: int) -> int:
        """Do what is due at a monotonic time [ns]; return when there is more to do."""
        return NEVER_NS


class ArmGoals(Goals):
    """Goals of an arm, which its cerebellum follows."""

    frames = (ARM_FRAME,)
    timeout_s = 130.0  # beyond the longest motion that is planned, of 120 s: a message has none

    def __init__(self, host: LiveHost) -> None:
        self._bridge = host.bridge
        self._refused: list[CommandResult] = []

    @override
    def submit(self, command: BrainCommand, frame: str) -> CommandResult | None:
        refusal = self._bridge.submit(command)
        if refusal is not None and refusal.code != ResultCode.DUPLICATE_ID:  # which is not among the results
            self._refused.append(refusal)
        return refusal

    @override
    def take_results(self) -> list[CommandResult]:
        ended = []
        for result in self._bridge.take_results():
            if result in self._refused:
                self._refused.remove(result)
            else:
                ended.append(result)
        return ended


class BaseGoals(Goals):
    """Goals of a base, which the brain `navigator` drives to, by the scan and the odometry.

    A goal ends the one before. It is reached within 0.1 m and 10 degrees, at rest; a slower one has more time for it.

    Args:
        host: the base, with odometry in its observation.
        odometry: what the robot publishes of its own odometry, whose frame `odom` is then; that of the host if None.
    """

    frames = (FOOTPRINT_FRAME, ODOM_FRAME)
    timeout_s = 120.0

    def __init__(self, host: LiveHost, odometry: Subscription | None = None) -> None:
        self._host, self._theirs = host, odometry
        self._origin: NDArray[np.float64] | None = np.zeros(3) if odometry is None else None  # of `odom`
        self._features = RobotFeatures(
            host.sensed_names, host.action_names, host.rates.fps, GOAL, host.body, robot_type=host.config.type
        )
        self._period_ns = NANOSECONDS // host.rates.fps
        self._brain = NavigatorBrain()
        self._command: BrainCommand | None = None
        self._goal: NDArray[np.float64] = np.zeros(3)  # x, y [m], yaw [rad] in the odometry's frame
        self._due_ns = self._end_ns = 0
        self._patience_s = 0.0
        self._asked = 0.0  # forward speed that was sent last [m/s]
        self._results: list[CommandResult] = []

    @override
    def submit(self, command: BrainCommand, frame: str) -> CommandResult | None:
        if refusal := self._refusal(command):
            return refusal
        pose = command.target_pose
        assert pose is not None
        matrix = pose.matrix()
        goal = np.array([matrix[0, 3], matrix[1, 3], math.atan2(matrix[1, 0], matrix[0, 0])])
        origin = self._origin_of(frame)
        if origin is None:
            topic = "" if self._theirs is None else self._theirs.topic.removeprefix("rt")
            text = f"The frame is {frame!r}, and the robot's odometry has not been received on {topic}."
            return CommandResult(command.task_id, False, ResultCode.BAD_TARGET, text)
        goal = np.array([*(origin[:2] + _turned(goal[:2], origin[2])), origin[2] + goal[2]])
        fastest = self._host.body.need(Drive).limits.velocity[0]
        speed = min(fastest, command.max_velocity or fastest)
        self._end(ResultCode.PREEMPTED, f"The goal {command.task_id!r} took its place.")
        self._brain = NavigatorBrain(NavigatorConfig(forward_speed=speed))
        self._brain.bind(self._features)
        self._brain.reset(_ONE, [0], 1)
        self._command, self._goal, self._due_ns = command, goal, 0
        self._patience_s = min(command.timeout_s * fastest / speed, _LONGEST_S)
        self._end_ns, self._asked = 0, float(self._host.bridge.latest["observation"][0, 0])
        return None

    def _refusal(self, command: BrainCommand) -> CommandResult | None:
        """Return why a goal is not followed, or None."""
        pose = command.target_pose
        assert pose is not None
        speed, change = command.max_velocity, command.max_acceleration
        mode = Mode(int(self._host.modes[0]))
        reasons = {
            (ResultCode.BAD_TARGET, "The goal has no name (task_id)."): not command.task_id,
            (ResultCode.DUPLICATE_ID, f"The goal {command.task_id!r} has not ended yet."): self._command is not None
            and command.task_id == self._command.task_id,
            (ResultCode.NON_FINITE, f"The target pose is {pose.position}, {pose.quaternion}."): not np.isfinite(
                [*pose.position, *pose.quaternion]
            ).all(),
            (ResultCode.NOT_NORMALISED, f"The quaternion {pose.quaternion} is not of unit length."): abs(
                np.linalg.norm(pose.quaternion) - 1
            )
            > 1e-3,
            (ResultCode.BAD_VELOCITY, f"max_velocity is {speed}; it is positive [m/s]."): speed is not None
            and not 0 < speed < math.inf,
            (ResultCode.BAD_ACCELERATION, f"max_acceleration is {change}; it is positive [m/s^2]."): change is not None
            and not 0 < change < math.inf,
            (ResultCode.ESTOP, Reason.ESTOP.explanation): self._host.estop_pressed,
            (ResultCode.NOT_ACTIVE, f"The robot is not active (mode {mode.name})."): mode
            not in (Mode.HOLD, Mode.TRACKING, Mode.STOPPING),
        }
        why = next((why for why, holds in reasons.items() if holds), None)
        return None if why is None else CommandResult(command.task_id, False, *why)

    def _origin_of(self, frame: str) -> NDArray[np.float64] | None:
        """Return x, y [m] and yaw [rad] of a frame in the host's odometry; None while that is not known."""
        own: NDArray[np.float64] = self._host.bridge.latest["state"]["odometry"]
        if frame == FOOTPRINT_FRAME:
            return own
        for received in [] if self._theirs is None else self._theirs.take()[-1:]:
            with suppress(DatasetError):
                pose = received.message().pose.pose
                turn = pose.orientation
                theirs = np.array([pose.position.x, pose.position.y, yaw_of(turn.w, turn.x, turn.y, turn.z)])
                if np.isfinite(theirs).all():
                    yaw = own[2] - theirs[2]
                    self._origin = np.array([*(own[:2] - _turned(theirs[:2], yaw)), yaw])
        return self._origin

    @override
    def take_results(self) -> list[CommandResult]:
        results, self._results = self._results, []
        return results

    @override
    def interrupt(self) -> None:
        self._end(ResultCode.REPLACED_BY_SETPOINT, "A twist came, and the newer command counts.")

    def _end(self, code: ResultCode, text: str) -> None:
        if self._command is not None:
            succeeded = code == ResultCode.SUCCEEDED
            self._results.append(CommandResult(self._command.task_id, succeeded, code, text))
            self._command = None

    @override
    def poll(self, now_ns: int) -> int:
        if self._command is None:
            return NEVER_NS
        if now_ns < self._due_ns:
            return self._due_ns
        self._end_ns = self._end_ns or now_ns + round(self._patience_s * NANOSECONDS)
        row = self._host.bridge.latest
        observed, (x, y, yaw) = row["observation"], row["state"]["odometry"].tolist()
        way, turn = self._goal[:2] - (x, y), self._goal[2] - yaw
        cos, sin = math.cos(yaw), math.sin(yaw)
        ahead, left = cos * way[0] + sin * way[1], -sin * way[0] + cos * way[1]
        speed, rate = observed[0, :2]
        off = abs(math.remainder(turn, math.tau))
        is_there = math.hypot(ahead, left) <= _TOLERANCE_M and off <= _TOLERANCE_RAD
        action = self._brain.act(
            Observation(
                self._features.observation_names,  # type: ignore[arg-type]
                observed,
                environment_state=np.array([[ahead, left, math.cos(turn), math.sin(turn)]]),
            )
        )
        wants_rest = not np.any(np.abs(action) > (_REST, _REST_TURN))
        if is_there and wants_rest and abs(speed) < _REST and abs(rate) < _REST_TURN:
            self._host.bridge.send(np.zeros((1, 2)))
            self._end(ResultCode.SUCCEEDED, f"{math.hypot(ahead, left):.3f} m and {math.degrees(off):.1f} degrees off")
            return NEVER_NS
        if now_ns > self._end_ns:
            self._host.bridge.send(np.zeros((1, 2)))
            self._end(
                ResultCode.TIMEOUT,
                f"Not there after {self._patience_s:.3g} s: {math.hypot(ahead, left):.2f} m off.",
            )
            return NEVER_NS
        reason = Reason(int(self._host.bridge.send(self._gently(action)).reasons[0]))
        if reason != Reason.ACCEPTED:
            code = {Reason.ESTOP: ResultCode.ESTOP, Reason.FAULT: ResultCode.FAULT}.get(reason, ResultCode.NOT_ACTIVE)
            self._end(code, reason.explanation)
            return NEVER_NS
        self._due_ns = now_ns + self._period_ns
        return self._due_ns

    def _gently(self, action: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return an action that speeds up no faster than the goal's acceleration; it brakes as the brain asks."""
        gentle = action.copy()
        if self._command is not None and self._command.max_acceleration is not None:
            before = abs(self._asked) if self._asked * gentle[0, 0] > 0 else 0.0
            most = before + self._command.max_acceleration * self._period_ns / NANOSECONDS
            gentle[0, 0] = np.clip(gentle[0, 0], -most, most)
        self._asked = float(gentle[0, 0])
        return gentle


def _turned(place: NDArray[np.float64], yaw: float) -> NDArray[np.float64]:
    """Return a place after a turn about the origin, shape (2,)."""
    cos, sin = math.cos(yaw), math.sin(yaw)
    return np.array([cos * place[0] - sin * place[1], sin * place[0] + cos * place[1]])
