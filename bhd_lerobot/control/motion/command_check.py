"""What is wrong with a goal before anything is planned: its form, its numbers, and the arm's ranges. Pure."""

import math
from typing import Any

import numpy as np

from bhd_lerobot.bodies.body import Arm
from bhd_lerobot.control.commands import MOTIONS, BrainCommand, Pose, ResultCode
from bhd_lerobot.control.motion.trajectory import PlanFailure
from bhd_lerobot.errors import unknown_name

MAX_TOOL_SPEED = 1.0  # [m/s] on a line; an estimate of what is sensible beside an arm of this size
MAX_TOOL_ACCELERATION = 5.0  # [m/s^2] on a line; likewise
MAX_TIMEOUT_S = 600.0  # [s]
NORM_ERROR = 1e-3  # a quaternion's norm may differ from 1 by this


def check(command: BrainCommand, arm: Arm) -> PlanFailure | None:
    """Return the first thing that is wrong with a goal for an arm, or None."""
    return (
        _check_form(command, len(arm.chain.joints))
        or _check_pose(command)
        or _check_ranges(command, arm)
        or _check_speed(command, arm)
    )


def _check_form(command: BrainCommand, dof: int) -> PlanFailure | None:
    pose, joints = command.target_pose, command.joint_target
    untyped: Any = command  # messages from outside may hold anything
    message = None
    if not isinstance(command.task_id, str) or not command.task_id:
        message = f"task_id is {command.task_id!r}; it must be a text that is not empty."
    elif command.motion not in MOTIONS:
        message = unknown_name("motion", command.motion, MOTIONS)
    elif not isinstance(untyped.preempt, bool):
        message = f"preempt is {command.preempt!r}; it must be True or False."
    elif pose is not None and not isinstance(untyped.target_pose, Pose):
        message = f"target_pose is {pose!r}; it must be a Pose of a position and a quaternion."
    elif pose is not None and joints is not None:
        message = "Both target_pose and joint_target are given; a goal takes one of them."
    elif pose is None and joints is None and command.gripper is None:
        message = "The goal has no target; give target_pose, joint_target or gripper."
    elif joints is not None and command.motion == "line":
        message = "A line needs target_pose; with joint_target the motion must be 'joint'."
    elif joints is not None and not are_numbers(joints, dof):
        message = f"joint_target is {joints!r}; it needs {dof} numbers [rad]."
    elif pose is not None and not (are_numbers(pose.position, 3) and are_numbers(pose.quaternion, 4)):
        message = f"target_pose is {pose!r}; it needs a position of 3 numbers [m] and a quaternion of 4."
    elif command.gripper is not None and not are_numbers((command.gripper,), 1):
        message = f"gripper is {command.gripper!r}; it must be a number [m]."
    return None if message is None else PlanFailure(ResultCode.BAD_TARGET, message)


def _check_pose(command: BrainCommand) -> PlanFailure | None:
    pose = command.target_pose
    if pose is None:
        return None
    if not np.isfinite((*pose.position, *pose.quaternion)).all():
        return PlanFailure(ResultCode.NON_FINITE, f"target_pose is {pose!r}; all its numbers must be finite.")
    norm = math.hypot(*pose.quaternion)
    if not abs(norm - 1.0) <= NORM_ERROR:
        return PlanFailure(
            ResultCode.NOT_NORMALISED,
            f"The norm of the quaternion {tuple(pose.quaternion)} is {norm:.6g}; it must be 1 ± {NORM_ERROR}.",
        )
    return None


def _check_ranges(command: BrainCommand, arm: Arm) -> PlanFailure | None:
    joints = command.joint_target
    if joints is not None:
        if not np.isfinite(joints).all():
            return PlanFailure(ResultCode.NON_FINITE, f"joint_target is {joints!r}; all its numbers must be finite.")
        limits = arm.limits
        for name, value, lower, upper in zip(arm.chain.joints, joints, limits.lower, limits.upper, strict=False):
            if not lower <= value <= upper:
                return PlanFailure(
                    ResultCode.JOINT_LIMIT,
                    f"The target of {name} is {value:.6g} rad; it must be within {lower:.6g} and {upper:.6g} rad.",
                )
    opening = command.gripper
    if opening is not None:
        if arm.gripper is None:
            return PlanFailure(
                ResultCode.BAD_TARGET, f"gripper is {opening}, and the arm has no gripper; leave it out."
            )
        if not math.isfinite(opening):
            return PlanFailure(ResultCode.NON_FINITE, f"gripper is {opening}; it must be finite.")
        if not 0.0 <= opening <= arm.gripper.max_opening:
            return PlanFailure(
                ResultCode.JOINT_LIMIT,
                f"gripper is {opening:.6g} m; the opening must be within 0 and {arm.gripper.max_opening} m.",
            )
    return None


def _check_speed(command: BrainCommand, arm: Arm) -> PlanFailure | None:
    dof = len(arm.chain.joints)
    if command.motion == "line" and command.target_pose is not None:
        unit, speed, change = "m", MAX_TOOL_SPEED, MAX_TOOL_ACCELERATION
    else:
        unit, speed, change = "rad", max(arm.limits.velocity[:dof]), max(arm.limits.acceleration[:dof])
    for name, value, largest, unit_of, code in (
        ("max_velocity", command.max_velocity, speed, f"{unit}/s", ResultCode.BAD_VELOCITY),
        ("max_acceleration", command.max_acceleration, change, f"{unit}/s^2", ResultCode.BAD_ACCELERATION),
    ):
        if value is not None and not (are_numbers((value,), 1) and 0.0 < value <= largest):
            return PlanFailure(
                code, f"{name} is {value!r}; for this motion it must be above 0 and at most {largest:.6g} {unit_of}."
            )
    if not (are_numbers((command.timeout_s,), 1) and 0.0 < command.timeout_s <= MAX_TIMEOUT_S):
        return PlanFailure(
            ResultCode.BAD_TIMEOUT,
            f"timeout_s is {command.timeout_s!r}; it must be above 0 and at most {MAX_TIMEOUT_S:g} s.",
        )
    return None


def are_numbers(values: Any, length: int) -> bool:
    """Tell whether these are so many numbers that a float can hold; messages from outside may hold anything."""
    try:
        array = np.asarray(values)
    except (ValueError, OverflowError):  # lists of different lengths
        return False
    return array.shape == (length,) and array.dtype.kind in "fiu"
