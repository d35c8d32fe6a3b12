"""What a tick does for an arm with position servos: setpoints, goals and stops to servo positions.

Where something rare is to be done, such as a plan, a tick waits for its controller: `move_arm` returns, and goes on
from there when it is called again.
"""

from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.control.arm.force_limit import feel
from bhd_lerobot.control.arm.held import follow_gripper
from bhd_lerobot.control.arm.setpoints import follow_setpoint, leave_setpoints, take_setpoint
from bhd_lerobot.control.kernels import clamp, kernel
from bhd_lerobot.control.messages import Limit
from bhd_lerobot.control.motion.player import play
from bhd_lerobot.control.motion.supervision import has_goals_to_serve, most_away

Array = NDArray[np.float64]

SURE = 8.0  # times its largest torque that a servo would have to give: 0.03 rad of a joint at rest
REST = 1e-6  # [rad/s, m/s] a reference slower than this is at rest
_PRESSED_N = 30.0  # [N] an arm that presses more is neither reset nor activated
_EFFORT = int(Limit.EFFORT)


class Stage(IntEnum):
    """What the controller is to do before a tick goes on."""

    NONE = 0
    BEGUN = 1
    """Take what the tick has begun with: modes, a setpoint."""
    HELD = 2
    """Note what the gripper holds or has lost."""
    GOALS = 3
    """Start and end goals and brakes."""
    STOPPED = 4
    """Let an arm that was stopped give way."""
    HINDERED = 5
    """Look at what is in its way, or presses on it."""
    ENDED = 6
    """Take what the tick has ended with: modes."""


_NONE, _BEGUN, _HELD, _GOALS, _STOPPED, _HINDERED, _ENDED = (int(one) for one in Stage)


@kernel()
def is_arm_at_rest(state: Any, arm: Any, limits: Any) -> bool:
    """Return whether an arm is commanded to be at rest, and it is known what it presses with."""
    for k in range(limits.width):
        if not abs(arm.speed[k]) < REST:
            return False
    is_settled = not arm.is_stopped or arm.rest_ticks > limits.settled_ticks
    return is_settled and not (state.busy or arm.yields or arm.gives_way)


@kernel()
def has_to_be_told(state: Any, arm: Any, limits: Any) -> bool:
    """Take the setpoint that a tick has begun with; return whether the controller has to take that, or a mode."""
    if state.goes_back or state.entered != 0 or state.is_distrusted:
        return True
    if state.has_setpoint:
        if state.busy:
            return True
        take_setpoint(state, arm, limits)
        state.has_setpoint = False
    return False


@kernel()
def move_arm(state: Any, arm: Any, limits: Any, geometry: Any, rows: Array, has_stamps: bool) -> bool:  # noqa: PLR0917
    """Advance an arm by one tick, up to what is to be written; return False if its controller is needed meanwhile.

    Args:
        limits: its record of `ARM_LIMITS`.
        geometry: its shapes, and what it holds.
        rows: what the player plays.
        has_stamps: whether readings have time stamps.
    """
    if arm.stage <= _BEGUN:
        arm.stage = _HELD
        if limits.holds and follow_gripper(state, arm, limits):
            return False
    if arm.stage == _HELD:
        if has_stamps:
            wait_for_reading(state, arm, limits)
        if arm.follows_setpoints:
            if state.busy:  # a goal that came after them takes over
                leave_setpoints(arm)
            else:
                follow_setpoint(state, arm, limits, geometry)
        arm.stage = _GOALS
        if has_goals_to_serve(state, arm, limits):
            return False
    if arm.stage == _GOALS:
        arm.has_left = False
        play(state, arm, limits, rows)
        arm.stage = _STOPPED
        if arm.is_stopped and not rests_quietly(state, arm, limits):
            return False
    if arm.stage == _STOPPED:
        lead_servos(state, arm, limits)
        arm.stage = _HINDERED
        presses = limits.feels and feel(state, arm, limits, geometry)
        if arm.is_blocked or presses or arm.is_lost:
            return False
    return True


@kernel()
def rests_quietly(state: Any, arm: Any, limits: Any) -> bool:
    """Return whether a stopped arm just goes on resting in this tick, and count it.

    Not where it comes to rest or gives way, it is decided whether it does, or a joint may be misread.
    """
    if arm.yields or arm.follows or arm.gives_way or arm.is_blind:
        return False
    is_settled = arm.rest_ticks + 1 > limits.settled_ticks
    for k in range(limits.width):
        if arm.speed[k] != 0.0:
            return False
        off = state.actuators[k] - state.position[k]
        wanted = limits.stiffness[k] * off - limits.damping[k] * state.velocity[k]
        if is_settled and k < limits.dof and not abs(wanted) <= SURE * limits.effort[k]:
            return False
    if is_settled and (arm.relief_ticks + 1) % limits.relief_period == 0:
        return False
    if not is_settled and arm.relief_ticks != 0:
        return False
    arm.rest_ticks += 1
    if is_settled:
        arm.relief_ticks += 1
    return True


@kernel()
def wait_for_reading(state: Any, arm: Any, limits: Any) -> None:
    """Count for how long nothing has been read: an arm that follows is behind what is read by so much more."""
    silent, arm.silent_ticks = arm.silent_ticks, 0 if state.stamp_ns != arm.read_ns else arm.silent_ticks + 1
    arm.read_ns = state.stamp_ns
    if silent != 0 or arm.silent_ticks != 0:
        arm.latency_s = arm.late_s + arm.silent_ticks / limits.hz + limits.latency_s


@kernel()
def lead_servos(state: Any, arm: Any, limits: Any) -> None:
    """Lead the servos' commands by their damping, so that they follow without a lag; note what does not follow.

    A servo beyond its effort gives its largest: that is flagged, and the command stays as it is. Holding the command
    near the joint, to ask for no more, would be a second loop around the servo, which a few milliseconds of latency
    turn into a brake. It goes on with its full torque for as long as its command is out of reach: for a while only.
    """
    is_limited = is_off = False
    for k in range(limits.width):
        arm.before[k] = state.actuators[k]
        state.actuators[k] = arm.speed[k] * limits.lead[k] + state.command[k]
        wanted = state.velocity[k] * limits.lead[k] + state.position[k] - state.actuators[k]
        is_limited = is_limited or abs(wanted) > limits.largest_error[k]
    if is_limited:
        state.limits |= _EFFORT
        for k in range(limits.dof):
            is_off = is_off or abs(state.command[k] - state.position[k]) > most_away(arm, limits, k)
    arm.off_ticks = arm.off_ticks + 1 if is_off and not arm.is_stopped else 0
    arm.is_blocked = arm.off_ticks >= limits.blocked_ticks


@kernel()
def report_arm(state: Any, arm: Any, limits: Any) -> None:
    """Write where the joints were read, the torques of their servos, and with what the arm presses, to the record."""
    for k in range(limits.width):
        state.measured[k] = state.position[k]
        torque = state.effort[k]
        if not state.has_effort:  # what the servos give beyond gravity
            off = state.actuators[k] - state.position[k]
            torque = limits.stiffness[k] * off - limits.damping[k] * state.velocity[k]
            torque = clamp(torque, -limits.effort[k], limits.effort[k])
        state.torque[k] = torque
    state.pressed = arm.force if arm.force > _PRESSED_N else 0.0
