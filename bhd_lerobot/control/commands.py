"""Commands of a brain: setpoints, action chunks and goals; and the results of goals.

A goal is accepted or refused, gives feedback while it runs, and ends in exactly one result.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Motion = Literal["joint", "line"]
MOTIONS: tuple[Motion, ...] = ("joint", "line")


class GoalPhase(IntEnum):
    """What the bridge is doing about goals; one for each simulation."""

    IDLE = 0
    """No goal."""
    CONVERTING = 1
    """A goal was accepted and is being turned into a trajectory."""
    EXECUTING = 2
    """The trajectory is being followed."""
    ERROR = 3
    """The last goal failed; the arm has stopped or is stopping, and the next goal is accepted."""


class ResultCode(IntEnum):
    """How a goal ended, or why it was refused."""

    SUCCEEDED = 0
    """The target is reached, or the gripper holds something."""
    CANCELLED = 1
    """`cancel` was called, or the arm is being stopped or deactivated."""
    PREEMPTED = 2
    """A goal with `preempt` took its place."""
    TIMEOUT = 3
    """Not reached within `timeout_s` of the start of its motion."""
    PATH_TOLERANCE = 4
    """A joint was measured too far from its reference."""
    GOAL_TOLERANCE = 5
    """Not within the tolerances in time after the end of the motion."""
    UNREACHABLE = 6
    """No posture reaches the pose, or a pose of the line."""
    JOINT_LIMIT = 7
    """A target out of range, or every posture for the pose has a joint out of range."""
    SELF_COLLISION = 8
    """The arm would come too close to itself, at the end or on the way."""
    TABLE_COLLISION = 9
    """The arm would come too close to the table, at the end or on the way."""
    SINGULAR = 10
    """The pose, or a part of the line, needs a singular posture."""
    NON_FINITE = 11
    """NaN or an infinity in a target."""
    NOT_NORMALISED = 12
    """The quaternion is not of unit length."""
    BAD_TARGET = 13
    """No target or two, a line without a pose, a wrong number of values, an unknown motion, or no name."""
    BAD_VELOCITY = 14
    """`max_velocity` is not positive, or above the range."""
    BAD_ACCELERATION = 15
    """`max_acceleration` is not positive, or above the range."""
    BAD_TIMEOUT = 16
    """`timeout_s` is not positive and finite."""
    DUPLICATE_ID = 17
    """A goal of this name has not ended yet."""
    UNKNOWN_ID = 18
    """No goal of this name is followed or waits."""
    QUEUE_FULL = 19
    """Too many goals wait."""
    NOT_ACTIVE = 20
    """The arm is not active."""
    ESTOP = 21
    """The emergency stop is latched, or was pressed while the goal was live."""
    FAULT = 22
    """A plant fault is latched, or happened while the goal was live."""
    PLANNING_FAILED = 23
    """No trajectory was found although everything is in range."""
    REPLACED_BY_SETPOINT = 24
    """A setpoint came, and the newer command counts."""
    OVERLOAD = 25
    """The motors cannot carry the declared load on this way."""


@dataclass(frozen=True)
class Pose:
    """A pose of the tool frame in the base frame.

    Attributes:
        position: x, y, z [m].
        quaternion: orientation, a unit quaternion w, x, y, z.
    """

    position: tuple[float, float, float]
    quaternion: tuple[float, float, float, float]

    def matrix(self) -> NDArray[np.float64]:
        """Return the homogeneous transform, shape (4, 4); the quaternion is normalised first."""
        w, x, y, z = np.asarray(self.quaternion, np.float64) / np.linalg.norm(self.quaternion)
        matrix = np.eye(4)
        matrix[0, :3] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
        matrix[1, :3] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
        matrix[2, :3] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
        matrix[:3, 3] = self.position
        return matrix


@dataclass(frozen=True)
class BrainCommand:
    """A goal: move the tool to a pose or the joints to a posture, the gripper to an opening, or both at once.

    Attributes:
        task_id: the sender's name for it; no two goals of one episode may have the same.
        target_pose: where the tool is to go; None for a goal that moves joints or the gripper only.
        joint_target: where the joints are to go [rad], one value for each; excludes `target_pose`.
        gripper: where the gripper is to open or close to [m of opening]; left as it is if None.
        motion: ``"joint"``: every joint on the shortest way, all arrive together; ``"line"``: the tool on a straight
            line, its orientation turning evenly.
        max_velocity: of the fastest joint [rad/s], or of the tool on a line [m/s]; the arm's own limit if None.
        max_acceleration: of the fastest joint [rad/s^2], or of the tool on a line [m/s^2]; the arm's own if None.
        timeout_s: the goal fails if it takes longer than this from the start of its motion [s].
        preempt: end the present goal and drop those that wait, and start from the commanded state at once; otherwise
            wait for them.
    """

    task_id: str
    target_pose: Pose | None = None
    joint_target: tuple[float, ...] | None = None
    gripper: float | None = None
    motion: Motion = "joint"
    max_velocity: float | None = None
    max_acceleration: float | None = None
    timeout_s: float = 20.0
    preempt: bool = False


@dataclass(frozen=True)
class Feedback:
    """How far a goal is.

    Attributes:
        task_id: the goal's.
        phase: what is being done about it.
        progress: share of the planned duration that has passed, 0 to 1.
        remaining_s: planned time that is left [s].
        position_error: largest distance of a joint from its reference [rad].
    """

    task_id: str
    phase: GoalPhase
    progress: float
    remaining_s: float
    position_error: float


@dataclass(frozen=True)
class CommandResult:
    """How a goal ended; every goal ends in exactly one.

    Attributes:
        task_id: the goal's.
        success: whether the target was reached.
        code: how it ended.
        message: what happened, as text, with the offending value where there is one.
    """

    task_id: str
    success: bool
    code: ResultCode
    message: str


@dataclass(frozen=True)
class Chunk:
    """Setpoints for several frames.

    Each takes effect when its frame begins, also if the brain is late. A new chunk replaces what is left of the one
    before; after the last setpoint of a chunk the robot holds.

    Attributes:
        actions: for this frame and those after it, shape (frames, n, actions), in the order of the action features.
    """

    actions: NDArray[np.float64]


_NONE = np.zeros(0, np.intp)


@dataclass(frozen=True)
class Goals:
    """Goals for n robots.

    Attributes:
        commands: new goals, by simulation; a robot without one continues with its present goal.
        setpoints: of the robots that follow none, shape (n, actions); rows of NaN for the others. None if all do.
    """

    commands: Mapping[int, Sequence[BrainCommand]]
    setpoints: NDArray[np.float64] | None = None

    @property
    def streamed(self) -> NDArray[np.intp]:
        """The robots that have setpoints."""
        return np.flatnonzero(np.isfinite(self.setpoints).all(axis=1)) if self.setpoints is not None else _NONE


Command = NDArray[np.float64] | Chunk | Goals | None
"""What n robots are to do: setpoints of shape (n, actions), in the order of the action features; a `Chunk` of them;
`Goals`; or None, to continue with the last chunk or goal."""
