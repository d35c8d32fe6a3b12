"""From a stream of position setpoints to a smooth reference within the limits of speed, acceleration and jerk."""

import math
from typing import Any

import numpy as np

from bhd_lerobot.bodies.body import Limits
from bhd_lerobot.control.arm.clearance import permitted_share
from bhd_lerobot.control.kernels import clamp, kernel, largest_change
from bhd_lerobot.control.messages import Limit
from bhd_lerobot.control.record import NEVER, put

# [1/s] How eagerly a remaining error is closed. With the jerk limit of a UR5 the first follows random setpoints best:
# less lags, more overshoots. Without a jerk limit it may be twice as much.
_GAIN, _GAIN_AT_ONCE = 25.0, 50.0
# The share of the acceleration limit that approaching a target may count on, so that discrete time leaves room.
_APPROACH = 0.7
_POSITION, _VELOCITY, _ACCELERATION = int(Limit.POSITION), int(Limit.VELOCITY), int(Limit.ACCELERATION)
_CLEARANCE = int(Limit.CLEARANCE)


def put_setpoint_limits(row: Any, limits: Limits, control_hz: int, frame_ticks: int) -> None:
    """Write into a record of `ARM_LIMITS` how setpoints are followed.

    Args:
        control_hz: ticks a second [Hz].
        frame_ticks: ticks in a frame, over which a setpoint is approached.
    """
    lower, upper = np.asarray(limits.lower), np.asarray(limits.upper)
    speed, acceleration = np.asarray(limits.velocity), np.asarray(limits.acceleration)
    # [rad/s, m/s] by which a speed changes while a brake's acceleration rises to its limit
    ramp = acceleration**2 / (2 * np.asarray(limits.jerk))
    jerk = np.asarray(limits.setpoint_jerk) / control_hz  # of an acceleration in a tick [rad/s^2, m/s^2]
    is_gradual = bool((jerk < 2 * acceleration).any())
    # Farther from an end of the range than this, any speed can be stopped in time: more than `stoppable` needs.
    room = 1.01 * (speed / control_hz + speed * (speed / 2 + ramp) / (_APPROACH * acceleration))
    row["width"], row["hz"], row["frame_ticks"], row["is_gradual"] = (
        len(limits.names),
        control_hz,
        frame_ticks,
        is_gradual,
    )
    # A larger gain would overshoot in a single tick.
    row["gain"] = min(_GAIN if is_gradual else _GAIN_AT_ONCE, control_hz / 2)
    values = {"lower": lower, "upper": upper, "near_lower": lower + room, "near_upper": upper - room}
    values |= {"fastest": speed, "hardest": acceleration, "ramp": ramp, "jerk": jerk}
    for name, value in values.items():
        put(row, name, value)


@kernel()
def stoppable(room: float, acceleration: float, ramp: float, hz: float) -> float:
    """Return the largest speed of the next tick that leaves enough room to stop in.

    In continuous time and at once that is the square root of 2 a x. A tick's motion at the full speed makes it a little
    less, and a brake that changes its acceleration gradually a little more: both fit.
    """
    slowing = _APPROACH * acceleration
    half = slowing / (2 * hz)
    tick_by_tick = min(math.sqrt(half * half + 2 * slowing * room) - half, room * hz)
    return min(tick_by_tick, math.sqrt(ramp * ramp + 2 * acceleration * room) - ramp)


@kernel()
def take_setpoint(state: Any, arm: Any, limits: Any) -> None:
    """Head for the setpoint that was taken.

    Over the frame that follows, the target moves evenly from where the last setpoint put it to the new one. One without
    a setpoint starts from the reference.
    """
    for k in range(limits.width):
        value = clamp(state.requested[k], limits.lower[k], limits.upper[k])
        if value != state.requested[k]:
            state.limits |= _POSITION
        if not arm.follows_setpoints:
            arm.target[k] = state.command[k]
        arm.goal[k] = value
        arm.step[k] = (value - arm.target[k]) / limits.frame_ticks
        arm.feed[k] = arm.step[k] * limits.hz
    arm.follows_setpoints = True
    arm.arrival = arm.runs + limits.frame_ticks
    arm.due = 0  # its clearance is checked in this tick


@kernel()
def follow_setpoint(state: Any, arm: Any, limits: Any, geometry: Any) -> None:
    """Advance the reference by a tick towards its setpoint.

    It follows the target with the target's own speed added, so that a steady motion is followed without a lag, and
    never beyond the limits of position, speed, acceleration and jerk. A target out of reach in one frame is approached
    as fast as the limits allow, and slower where it would come too near to something.
    """
    arm.runs += 1
    want_speeds(state, arm, limits)
    if limits.keeps_clear and arm.due <= arm.runs:
        arm.due = arm.runs + limits.look_ticks
        arm.share = permitted_share(arm, limits, geometry, state.command)
    if arm.share < 1.0:
        state.limits |= _CLEARANCE
    for k in range(limits.width):
        wanted = arm.wanted[k] * arm.share if k < limits.dof else arm.wanted[k]  # the gripper is free
        change = (wanted - arm.speed[k]) * limits.hz
        allowed = clamp(change, -limits.hardest[k], limits.hardest[k])
        if allowed != change:
            state.limits |= _ACCELERATION
        if limits.is_gradual:  # near to the last one, and small enough to end when the speed is there
            most = largest_change(abs(change) / limits.jerk[k]) * limits.jerk[k]
            allowed = clamp(allowed, -most, most)
            allowed = clamp(allowed, arm.change[k] - limits.jerk[k], arm.change[k] + limits.jerk[k])
        arm.change[k] = allowed
        arm.speed[k] += allowed / limits.hz
        state.command[k] += arm.speed[k] / limits.hz


@kernel()
def want_speeds(state: Any, arm: Any, limits: Any) -> None:
    """Move the target on, and write the speeds that lead to it, within the limits of speed and position."""
    arrives = arm.arrival == arm.runs
    for k in range(limits.width):
        # Sums of steps miss the goal by their rounding.
        arm.target[k] = arm.goal[k] if arrives else arm.target[k] + arm.step[k]
        where, error = state.command[k], arm.target[k] - state.command[k]
        # Faster than this it could not slow down in time to stop at the target.
        fast = math.sqrt(2 * _APPROACH * limits.hardest[k] * abs(error))
        wanted = math.copysign(min(abs(error) * limits.gain, fast), error) + arm.feed[k]
        if wanted > 0.0 and where > limits.near_upper[k]:
            room = max(limits.upper[k] - where, 0.0)
            wanted = min(wanted, stoppable(room, limits.hardest[k], limits.ramp[k], limits.hz))
        if wanted < 0.0 and where < limits.near_lower[k]:
            room = max(where - limits.lower[k], 0.0)
            wanted = max(wanted, -stoppable(room, limits.hardest[k], limits.ramp[k], limits.hz))
        arm.wanted[k] = clamp(wanted, -limits.fastest[k], limits.fastest[k])
        if arm.wanted[k] != wanted:
            state.limits |= _VELOCITY
        if arrives:
            arm.step[k] = arm.feed[k] = 0.0
    if arrives:
        arm.arrival = NEVER


@kernel()
def leave_setpoints(arm: Any) -> None:
    """Follow no setpoint any more.

    What comes next starts without speeding up: goals and brakes change their acceleration more gradually, and one that
    went on from the acceleration of a setpoint near the limit of speed would exceed it.
    """
    if arm.follows_setpoints:
        arm.has_left = True
    arm.follows_setpoints, arm.share = False, 1.0
