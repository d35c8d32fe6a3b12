"""Where keys have moved an arm to: a target that starts at the measured pose and stays near it."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from bhd_lerobot.bodies.body import Arm
from bhd_lerobot.control.commands import ResultCode
from bhd_lerobot.control.geometry.kinematics import ArmKinematics
from bhd_lerobot.control.geometry.poses import pose_vectors
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.robots.parts.names import TOOL_NAMES

Array = NDArray[np.float64]

POSE_NAMES = TOOL_NAMES[:-1]
LEASH_M, LEASH_RAD = 0.05, 0.2
"""The farthest that a target is from the measured pose: what an arm that is held up still moves by when it is free."""
_LARGEST_TURN = 0.5  # [rad] of a joint in one step of the tool: beyond it the arm would take another posture


class Target(Protocol):
    """A target of an arm, without the gripper.

    Attributes:
        names: of its values.
    """

    names: tuple[str, ...]

    def values(self) -> list[float]:
        """Return it, in the order of `names`."""

    def move(self, change: Array, observation: Mapping[str, Any]) -> None:
        """Move it by a change of shape (7,), and keep it near to what is observed.

        Of joints it is one for each, of a tool along and about x, y, z: what is beyond these means nothing.
        """


def joint_names(arm: Arm) -> tuple[str, ...]:
    """Return the features of an arm's joint positions."""
    return tuple(f"{joint}.pos" for joint in arm.chain.joints)


def _read(observation: Mapping[str, Any], names: Sequence[str]) -> Array | None:
    """Return values of an observation, or None where it has not all of them."""
    return np.array([float(observation[name]) for name in names]) if set(names) <= observation.keys() else None


class JointTarget:
    """Positions of an arm's joints [rad].

    Args:
        observation: where they are.
        arm: whose joints they are.

    Raises:
        ConfigError: the observation lacks them.
    """

    def __init__(self, observation: Mapping[str, Any], arm: Arm) -> None:
        self.names = joint_names(arm)
        self._joints = self._measured(observation)

    def _measured(self, observation: Mapping[str, Any]) -> Array:
        joints = _read(observation, self.names)
        if joints is None:
            raise ConfigError(
                f"The observation has {', '.join(observation)}; to turn joints it needs {', '.join(self.names)}."
            )
        return joints

    def values(self) -> list[float]:
        """Return the joint positions."""
        return self._joints.tolist()

    def move(self, change: Array, observation: Mapping[str, Any]) -> None:
        """Turn joints [rad]."""
        measured = self._measured(observation)
        turned = self._joints + change[: len(measured)]
        self._joints = np.clip(turned, measured - LEASH_RAD, measured + LEASH_RAD)


class ToolTarget:
    """A pose of the tool in the base frame.

    Where the joints are observed, too, the target stops where no posture of the arm reaches it, or only one with
    another elbow or wrist: the robot would refuse it.

    Args:
        observation: where the tool is; if it lacks the tool's pose, that follows from the joints.
        arm: what the joints move.
        report: gets why the target stops, when it does.

    Raises:
        ConfigError: the observation has neither.
    """

    names: tuple[str, ...] = POSE_NAMES

    def __init__(self, observation: Mapping[str, Any], arm: Arm, report: Callable[[str], None]) -> None:
        self._kinematics = ArmKinematics(arm.chain, arm.limits)
        self._report = report
        self._joints = joint_names(arm)
        self._posture = _read(observation, self._joints)
        self._position, self._rotation = self._measured(observation)
        self._is_stopped = False

    def _measured(self, observation: Mapping[str, Any]) -> tuple[Array, Rotation]:
        pose = _read(observation, POSE_NAMES)
        if pose is not None:
            return pose[:3], Rotation.from_quat(pose[3:], scalar_first=True)
        joints = _read(observation, self._joints)
        if joints is None:
            raise ConfigError(
                f"The observation has {', '.join(observation)}; to move the tool it needs {', '.join(POSE_NAMES)}, or "
                f"the joints, {', '.join(self._joints)}. An arm observes the tool with --robot.tool_pose=true."
            )
        matrix = self._kinematics.tool(joints)
        return matrix[:3, 3], Rotation.from_matrix(matrix[:3, :3])

    def values(self) -> list[float]:
        """Return position [m] and quaternion wxyz."""
        return pose_vectors(_matrix(self._position, self._rotation)).tolist()

    def move(self, change: Array, observation: Mapping[str, Any]) -> None:
        """Move the tool along [m] and turn it about [rad] the axes of the base frame."""
        position, rotation = self._measured(observation)
        offset = self._position + change[:3] - position
        turn = (Rotation.from_rotvec(change[3:6]) * self._rotation * rotation.inv()).as_rotvec()
        wanted = position + _shortened(offset, LEASH_M), Rotation.from_rotvec(_shortened(turn, LEASH_RAD)) * rotation
        problem = self._problem(_matrix(*wanted))
        if not problem:
            self._position, self._rotation = wanted
        elif not self._is_stopped:
            self._report(problem)
        self._is_stopped = bool(problem)

    def _problem(self, pose: Array) -> str:
        """Return why the arm cannot follow to a pose, or nothing; take note of the posture if it can."""
        if self._posture is None:
            return ""
        result = self._kinematics.continued(pose, self._posture)
        if result.code != ResultCode.SUCCEEDED:
            return result.message
        if np.abs(result.postures[0] - self._posture).max() > _LARGEST_TURN:
            return "The arm would have to take another posture at once. Move another way, or turn the tool first."
        self._posture = result.postures[0]
        return ""


def _shortened(vector: Array, most: float) -> Array:
    return vector * min(1.0, most / max(float(np.linalg.norm(vector)), 1e-12))


def _matrix(position: Array, rotation: Rotation) -> Array:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation.as_matrix(), position
    return matrix
