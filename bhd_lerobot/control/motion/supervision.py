"""Whether a goal that is being followed is on its way, has arrived or has failed."""

import math
from enum import IntEnum
from typing import Any

import numpy as np

from bhd_lerobot.bodies.body import Arm
from bhd_lerobot.control.commands import BrainCommand, ResultCode
from bhd_lerobot.control.kernels import kernel

JOINT_STILL = 0.01  # [rad/s] a joint that has arrived is also slower than this: it does not move
SETTLING_S = 0.5  # [s] after its trajectory's end that the arm may take to arrive
OPENING_TOLERANCE = 0.002  # [m] a gripper this close to its target has arrived
GRIPPER_STILL = 0.002  # [m/s] a gripper that is slower than this
GRIPPER_STALL_S = 0.1  # [s] for so long, though it is not to be at rest where it is, holds something
GRIPPING_S = 1.5  # [s] after its trajectory's end that a gripper may take to arrive or to hold something


class Verdict(IntEnum):
    """What has become of a goal."""

    NONE = 0
    OFF = 1
    ARRIVED = 2
    NOT_ARRIVED = 3
    NOT_GRIPPED = 4
    TIMEOUT = 5


_NONE, _OFF, _ARRIVED, _NOT_ARRIVED, _NOT_GRIPPED, _TIMEOUT = (int(one) for one in Verdict)


def put_goal_limits(row: Any, arm: Arm, control_hz: int) -> None:
    """Write into a record of `ARM_LIMITS` how goals are judged."""
    row["dof"] = dof = len(arm.chain.joints)
    row["blocked_rad"], row["latency_s"], row["arrived_rad"] = arm.blocked_rad, arm.latency_s, arm.arrived_rad
    row["acceleration"][:dof] = arm.limits.acceleration[:dof]
    seconds = {"settling": SETTLING_S, "gripping": GRIPPING_S, "stall": GRIPPER_STALL_S}
    for name, value in seconds.items():
        row[f"{name}_ticks"] = round(value * control_hz)


def begin_goal(row: Any, command: BrainCommand, target: Any, control_hz: int) -> None:
    """Forget the last goal of an arm; judge a new one, whose trajectory ends at a target of shape (dof + 1,)."""
    row["aim"][: len(target)] = target
    row["moves_arm"] = command.target_pose is not None or command.joint_target is not None
    row["moves_gripper"] = command.gripper is not None
    row["deadline"] = math.ceil(command.timeout_s * control_hz - 1e-6)
    for name in ("age", "since_end", "still", "away"):
        row[name] = 0


@kernel()
def most_away(arm: Any, limits: Any, joint: int) -> float:
    """Return how far a joint that follows its reference may be from it [rad].

    One with a latency is where its reference was so long ago: behind by what the present speed, and a change of it at
    the largest acceleration, make of that time.
    """
    most = limits.blocked_rad
    if arm.latency_s != 0.0:  # 0 times infinity is no number
        most += limits.acceleration[joint] * arm.latency_s * arm.latency_s / 2
        most += abs(arm.speed[joint]) * arm.latency_s
    return most


@kernel()
def has_goals_to_serve(state: Any, arm: Any, limits: Any) -> bool:
    """Judge the goal that is followed; return whether one, or a brake, is to be started or to be ended."""
    if not state.busy:
        return False
    arm.at_tick += 1
    if arm.is_judged:
        arm.verdict = judge_goal(state, arm, limits)
    return arm.verdict != _NONE or arm.waits or (arm.brakes and arm.row >= arm.end)


@kernel()
def judge_goal(state: Any, arm: Any, limits: Any) -> int:
    """Judge a goal by what is measured; return a `Verdict`."""
    arm.age += 1
    is_off, last = False, limits.dof
    for k in range(last):
        arm.away[k], arm.most[k] = abs(state.position[k] - state.command[k]), most_away(arm, limits, k)
        is_off = is_off or arm.away[k] > arm.most[k]
    stands = abs(state.velocity[last]) < GRIPPER_STILL and arm.speed[last] == 0.0
    arm.still = arm.still + 1 if stands else 0
    if is_off:
        return _OFF
    if arm.row >= arm.end:
        verdict = judge_end(state, arm, limits)
        if verdict != _NONE:
            return verdict
    return _TIMEOUT if arm.age >= arm.deadline else _NONE


@kernel()
def judge_end(state: Any, arm: Any, limits: Any) -> int:
    """Judge a goal whose trajectory has ended; return a `Verdict`."""
    arm.since_end += 1
    last, is_away = limits.dof, False
    for k in range(last):
        off = abs(state.position[k] - arm.aim[k])
        is_away = is_away or off / limits.arrived_rad > 1.0 or abs(state.velocity[k]) / JOINT_STILL > 1.0
    is_away = is_away and arm.moves_arm
    is_open = arm.moves_gripper and abs(state.position[last] - arm.aim[last]) > OPENING_TOLERANCE
    is_open = is_open and arm.still < limits.stall_ticks
    if not is_away and not is_open:
        return _ARRIVED
    if is_away and arm.since_end > limits.settling_ticks:
        return _NOT_ARRIVED
    return _NOT_GRIPPED if is_open and arm.since_end > limits.gripping_ticks else _NONE


def explain_verdict(verdict: int, body_arm: Arm, state: Any, arm: Any, control_hz: int) -> tuple[ResultCode, str]:
    """Return a verdict as the goal's result, and as text, with the offending value and the limit."""
    joints, dof = body_arm.chain.joints, len(body_arm.chain.joints)
    position, opening, target = state["position"][:dof], float(state["position"][dof]), float(arm["aim"][dof])
    if verdict == Verdict.OFF:
        away, most = arm["away"][:dof], arm["most"][:dof]
        joint = int((away - most).argmax())
        text = f"{joints[joint]} is {away[joint]:.3f} rad from its reference; {most[joint]:.3g} rad is the most: "
        return ResultCode.PATH_TOLERANCE, text + "something is in its way, or it carries too much."
    if verdict == Verdict.TIMEOUT:
        seconds = arm["deadline"] / control_hz
        return ResultCode.TIMEOUT, f"The goal was not reached within its {seconds:.3g} s."
    if verdict == Verdict.NOT_ARRIVED:
        off, speed = abs(position - arm["aim"][:dof]), abs(state["velocity"][:dof])
        joint = int(np.maximum(off / body_arm.arrived_rad, speed / JOINT_STILL).argmax())
        return ResultCode.GOAL_TOLERANCE, (
            f"{joints[joint]} is {off[joint]:.4f} rad from its target at {speed[joint]:.3f} rad/s, "
            f"{SETTLING_S} s after the end of the motion; "
            f"{body_arm.arrived_rad:.4g} rad and {JOINT_STILL} rad/s are the most."
        )
    if verdict == Verdict.NOT_GRIPPED:
        return ResultCode.GOAL_TOLERANCE, (
            f"The gripper has neither reached {target:.4f} m nor stalled {GRIPPING_S} s after the "
            f"end of the motion; the opening is {opening:.4f} m."
        )
    text = "The target is reached."
    if arm["moves_gripper"]:
        text = f"The target is reached; the opening is {opening:.4f} m."
        if abs(opening - target) > OPENING_TOLERANCE:
            text = f"The gripper has stalled on its way to {target:.4f} m; the opening is {opening:.4f} m."
    return ResultCode.SUCCEEDED, text
