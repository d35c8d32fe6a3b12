"""Goals, results and feedback as records of fixed size, so that two processes can exchange them without pickling."""

from typing import Any

import numpy as np

from bhd_lerobot.control.commands import (
    MOTIONS,
    BrainCommand,
    CommandResult,
    Feedback,
    GoalPhase,
    Pose,
    ResultCode,
)
from bhd_lerobot.control.motion.command_check import are_numbers
from bhd_lerobot.control.motion.trajectory import PlanFailure
from bhd_lerobot.errors import ActionError, unknown_name

NAME_BYTES = 64  # that a task_id may take in UTF-8
MESSAGE_BYTES = 512  # that a message may take in UTF-8; a longer one is cut
_ELLIPSIS = "…".encode()
_NAME = [("name", f"S{NAME_BYTES}"), ("name_size", np.int16)]  # bytes of numpy forget the zeros that they end in

RESULT_DTYPE = np.dtype(
    [*_NAME, ("success", np.bool_), ("code", np.int8), ("message", f"S{MESSAGE_BYTES}"), ("message_size", np.int16)],
    align=True,
)
"""A `CommandResult`."""

FEEDBACK_DTYPE = np.dtype(
    [
        ("present", np.bool_),
        *_NAME,
        ("phase", np.int8),
        ("progress", np.float64),
        ("remaining_s", np.float64),
        ("position_error", np.float64),
    ],
    align=True,
)
"""A `Feedback`, or that there is none."""

# Fields of a goal that may be left out, and under which code each is refused.
_OPTIONAL = {
    "gripper": ResultCode.BAD_TARGET,
    "max_velocity": ResultCode.BAD_VELOCITY,
    "max_acceleration": ResultCode.BAD_ACCELERATION,
}


def goal_dtype(dof: int) -> np.dtype:
    """Return the dtype of goals for an arm with so many joints; 0 for a robot that has none."""
    return np.dtype(
        [
            *_NAME,
            ("has_pose", np.bool_),
            ("position", np.float64, (3,)),
            ("quaternion", np.float64, (4,)),
            ("has_joints", np.bool_),
            ("joint_target", np.float64, (dof,)),
            *((f"has_{name}", np.bool_) for name in _OPTIONAL),
            *((name, np.float64) for name in _OPTIONAL),
            ("motion", np.int8),
            ("timeout_s", np.float64),
            ("preempt", np.bool_),
        ],
        align=True,
    )


# --- goals -----------------------------------------------------------------------------------------------------------


def check_encodable(command: BrainCommand, dof: int) -> PlanFailure | None:
    """Return why a goal does not fit into a record, or None.

    What fits is not yet a goal that an arm can follow; that is found out where the goal is taken.
    """
    untyped: Any = command  # messages from outside may hold anything
    name, pose, joints = untyped.task_id, untyped.target_pose, untyped.joint_target
    code, message = ResultCode.BAD_TARGET, None
    if not isinstance(name, str) or not name:
        message = f"task_id is {name!r}; it must be a text that is not empty."
    elif (size := len(_encode(name))) > NAME_BYTES:
        message = f"task_id {name!r} takes {size} bytes in UTF-8; in real time {NAME_BYTES} are the most: shorten it."
    elif untyped.motion not in MOTIONS:
        message = unknown_name("motion", untyped.motion, MOTIONS)
    elif not isinstance(untyped.preempt, bool):
        message = f"preempt is {untyped.preempt!r}; it must be True or False."
    elif pose is not None and not (
        isinstance(pose, Pose) and are_numbers(pose.position, 3) and are_numbers(pose.quaternion, 4)
    ):
        message = f"target_pose is {pose!r}; it needs a position of 3 numbers [m] and a quaternion of 4."
    elif joints is not None and not are_numbers(joints, dof):
        message = f"joint_target is {joints!r}; it needs {dof} numbers [rad]."
    elif not are_numbers((untyped.timeout_s,), 1):
        code, message = ResultCode.BAD_TIMEOUT, f"timeout_s is {untyped.timeout_s!r}; it must be a number [s]."
    elif field := next((name for name in _OPTIONAL if not _is_number_or_none(getattr(untyped, name))), ""):
        code, message = _OPTIONAL[field], f"{field} is {getattr(untyped, field)!r}; it must be a number, or left out."
    return None if message is None else PlanFailure(code, message)


def encode_goal(command: BrainCommand, dof: int) -> np.void:
    """Return a goal that fits, see `check_encodable`, as a record of `goal_dtype(dof)`."""
    record = np.zeros(1, goal_dtype(dof))[0]
    _write_name(record, command.task_id)
    write_goal(record, command)
    return record


def write_goal(record: Any, command: BrainCommand) -> None:
    """Write all of a goal but its name into a record of `goal_dtype(dof)`; the goal must fit."""
    pose, joints = command.target_pose, command.joint_target
    record["has_pose"], record["has_joints"] = pose is not None, joints is not None
    if pose is not None:
        record["position"], record["quaternion"] = pose.position, pose.quaternion
    if joints is not None:
        record["joint_target"] = joints
    for field in _OPTIONAL:
        value = getattr(command, field)
        record[f"has_{field}"] = value is not None
        record[field] = 0.0 if value is None else value
    record["motion"] = MOTIONS.index(command.motion)
    record["timeout_s"], record["preempt"] = command.timeout_s, command.preempt


def decode_goal(record: Any) -> BrainCommand:
    """Return the goal in a record of `goal_dtype(dof)`."""
    position, quaternion = record["position"].tolist(), record["quaternion"].tolist()
    options = {field: float(record[field]) if record[f"has_{field}"] else None for field in _OPTIONAL}
    return BrainCommand(
        task_id=decode_name(record),
        target_pose=Pose(tuple(position), tuple(quaternion)) if record["has_pose"] else None,
        joint_target=tuple(record["joint_target"].tolist()) if record["has_joints"] else None,
        motion=MOTIONS[int(record["motion"])],
        timeout_s=float(record["timeout_s"]),
        preempt=bool(record["preempt"]),
        **options,
    )


def encode_name(task_id: str, dof: int) -> np.void:
    """Return a record of `goal_dtype(dof)` that holds the name of a goal only.

    Raises:
        ActionError: the name is too long.
    """
    record = np.zeros(1, goal_dtype(dof))[0]
    _write_name(record, task_id)
    return record


def decode_name(record: Any) -> str:
    """Return the task_id in a record of a goal, a result or a feedback."""
    return _decode(record["name"], int(record["name_size"]))


# --- results and feedback --------------------------------------------------------------------------------------------


def encode_result(result: CommandResult) -> np.void:
    """Return a result as a record of `RESULT_DTYPE`; a message that is too long ends in an ellipsis.

    Raises:
        ActionError: the task_id is too long.
    """
    record = np.zeros(1, RESULT_DTYPE)[0]
    _write_name(record, result.task_id)
    record["success"], record["code"] = result.success, result.code
    write_message(record, result.message)
    return record


def decode_result(record: Any) -> CommandResult:
    """Return the result in a record of `RESULT_DTYPE`."""
    return CommandResult(
        decode_name(record), bool(record["success"]), ResultCode(int(record["code"])), decode_message(record)
    )


def write_message(record: Any, message: str) -> None:
    """Write a message into a record with fields `message` and `message_size`; one that is too long is cut."""
    data = _encode(message)
    if len(data) > MESSAGE_BYTES:
        end = MESSAGE_BYTES - len(_ELLIPSIS)
        while data[end] & 0xC0 == 0x80:  # inside of a character
            end -= 1
        data = data[:end] + _ELLIPSIS
    record["message"], record["message_size"] = data, len(data)


def decode_message(record: Any) -> str:
    """Return the message in a record with fields `message` and `message_size`."""
    return _decode(record["message"], int(record["message_size"]))


def write_feedback(record: Any, feedback: Feedback | None) -> None:
    """Write feedback, or that there is none, into a record of `FEEDBACK_DTYPE`.

    Raises:
        ActionError: the task_id is too long.
    """
    record["present"] = feedback is not None
    if feedback is not None:
        _write_name(record, feedback.task_id)
        record["phase"], record["progress"] = feedback.phase, feedback.progress
        record["remaining_s"], record["position_error"] = feedback.remaining_s, feedback.position_error


def decode_feedback(record: Any) -> Feedback | None:
    """Return the feedback in a record of `FEEDBACK_DTYPE`, or None if there is none."""
    if not record["present"]:
        return None
    numbers = (float(record[field]) for field in ("progress", "remaining_s", "position_error"))
    return Feedback(decode_name(record), GoalPhase(int(record["phase"])), *numbers)


# --- texts and numbers -----------------------------------------------------------------------------------------------


def _write_name(record: Any, name: str) -> None:
    data = _encode(name)
    if len(data) > NAME_BYTES:
        raise ActionError(f"task_id {name!r} takes {len(data)} bytes in UTF-8; {NAME_BYTES} are the most: shorten it.")
    record["name"], record["name_size"] = data, len(data)


def _encode(text: str) -> bytes:
    return text.encode("utf-8", "surrogatepass")


def _decode(data: bytes, size: int) -> str:
    return bytes(data).ljust(size, b"\0").decode("utf-8", "surrogatepass")


def _is_number_or_none(value: Any) -> bool:
    return value is None or are_numbers((value,), 1)
