"""Where an impedance's spring is at rest: a tool pose and an opening that move within limits.

They follow setpoints that come once a frame, along straight lines, however far a setpoint is. Over the frame that
follows a setpoint the target moves evenly from where the last setpoint put it to the new one. The equilibrium follows
the target with the target's own speed added, never faster than the limits. Without a setpoint it brakes to rest.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.control.geometry.rotations import find_way, normalise, turn_by
from bhd_lerobot.control.kernels import clamp, kernel
from bhd_lerobot.control.messages import Limit

Array = NDArray[np.float64]

# How fast an equilibrium may move beside a person: ISO 10218-1 permits 250 mm/s, the others are estimates.
SPEED, ACCELERATION = 0.25, 1.0  # [m/s, m/s^2]
TURN_SPEED, TURN_ACCELERATION = 1.0, 4.0  # [rad/s, rad/s^2]
_GAIN = 50.0  # [1/s] how eagerly a remaining error is closed
_APPROACH = 0.7  # share of the acceleration that approaching a target may count on: room for discrete time
_REST = 1e-6  # [m/s, rad/s] slower than this is at rest
_LEAST_NORM, _MOST_NORM = 0.5, 2.0  # a quaternion with a norm beyond these is no orientation with a rounding error
_TINY = 1e-12
_NON_FINITE, _POSITION = int(Limit.NON_FINITE), int(Limit.POSITION)
_VELOCITY, _ACCELERATION = int(Limit.VELOCITY), int(Limit.ACCELERATION)


@kernel()
def head_for_setpoint(state: Any, spring: Any, limits: Any) -> bool:
    """Head for what was requested; return False if that is no pose: another process writes the queue."""
    square, is_finite = 0.0, True
    for k in range(8):
        value = state.requested[k]
        is_finite = is_finite and math.isfinite(value)
        if 3 <= k < 7:
            square += value * value
    if not (is_finite and _LEAST_NORM < math.sqrt(square) < _MOST_NORM):
        state.limits |= _NON_FINITE
        return False
    if not spring.is_active:
        spring.target_opening = spring.opening
        for k in range(3):
            spring.target[k] = spring.place[k]
        for k in range(4):
            spring.target_turn[k] = spring.turn[k]
    rate = limits.hz / limits.frame_ticks
    for k in range(4):
        spring.goal_turn[k] = state.requested[3 + k]
    normalise(spring.goal_turn)
    find_way(spring.feed[3:], spring.goal_turn, spring.target_turn)
    is_beyond = False
    for k in range(3):
        spring.goal[k] = clamp(state.requested[k], -limits.most_reach, limits.most_reach)
        is_beyond = is_beyond or spring.goal[k] != state.requested[k]
        spring.feed[k] = (spring.goal[k] - spring.target[k]) * rate
        spring.feed[k + 3] *= rate
    spring.goal_opening = clamp(state.requested[7], limits.lower[limits.dof], limits.upper[limits.dof])
    if is_beyond or spring.goal_opening != state.requested[7]:
        state.limits |= _POSITION
    spring.opening_feed = (spring.goal_opening - spring.target_opening) * rate
    spring.left, spring.is_active = limits.frame_ticks, True
    return True


@kernel()
def put_at_tool(spring: Any) -> None:
    """Put the tool's equilibrium where the tool is, at rest, and follow no setpoint."""
    for k in range(3):
        spring.place[k] = spring.tool[k]
    for k in range(4):
        spring.turn[k] = spring.tool_turn[k]
    for k in range(6):
        spring.speed[k] = 0.0
    spring.is_active = False


@kernel()
def keep_near(spring: Any, part: int, share: float) -> None:
    """Bring the equilibrium nearer to the tool, and stop it there: what is in the tool's way stops both.

    Args:
        part: 0 for the position, 1 for the orientation.
        share: of the way between them that remains.
    """
    if share >= 1.0:
        return
    if part == 0:
        for k in range(3):
            spring.place[k] = spring.tool[k] + (spring.place[k] - spring.tool[k]) * share
    else:
        find_way(spring.side, spring.turn, spring.tool_turn)
        for k in range(4):
            spring.turn[k] = spring.tool_turn[k]
        turn_by(spring.turn, spring.side, share)
    for k in range(3):
        spring.speed[3 * part + k] = 0.0


@kernel()
def move_equilibrium(state: Any, spring: Any, limits: Any) -> None:
    """Advance the equilibrium by one tick."""
    if not spring.is_active and is_equilibrium_still(spring, 0.0):
        return
    hz, is_moving = limits.hz, spring.is_active and spring.left > 0
    if is_moving:
        move_target(spring, hz)
        spring.left -= 1
    error = spring.error
    find_way(error[3:], spring.target_turn, spring.turn)
    for k in range(3):
        error[k] = spring.target[k] - spring.place[k]
    feed = 1.0 if is_moving else 0.0
    gap = spring.target_opening - spring.opening
    if not spring.is_active:
        gap = 0.0
        for k in range(6):
            error[k] = 0.0
    approach(state, spring, hz, 0, feed, SPEED, ACCELERATION)
    approach(state, spring, hz, 3, feed, TURN_SPEED, TURN_ACCELERATION)
    fastest, hardest = limits.fastest[limits.dof], limits.hardest[limits.dof]
    wanted = feed * spring.opening_feed + math.copysign(closing_speed(abs(gap), hardest), gap)
    change = clamp(wanted, -fastest, fastest) - spring.opening_speed
    flag_limits(state, spring, abs(wanted) > fastest, abs(change) * hz > hardest)
    spring.opening_speed += clamp(change, -hardest / hz, hardest / hz)
    for k in range(3):
        spring.place[k] += spring.speed[k] / hz
    opening = spring.opening + spring.opening_speed / hz
    spring.opening = clamp(opening, limits.lower[limits.dof], limits.upper[limits.dof])
    turn_by(spring.turn, spring.speed[3:], 1.0 / hz)


@kernel()
def move_target(spring: Any, hz: float) -> None:
    """Move the target within the frame after a setpoint; sums of steps miss its end by their rounding."""
    if spring.left > 1:
        spring.target_opening += spring.opening_feed / hz
        for k in range(3):
            spring.target[k] += spring.feed[k] / hz
        turn_by(spring.target_turn, spring.feed[3:], 1.0 / hz)
        return
    spring.target_opening = spring.goal_opening
    for k in range(3):
        spring.target[k] = spring.goal[k]
    for k in range(4):
        spring.target_turn[k] = spring.goal_turn[k]


@kernel()
def approach(  # noqa: PLR0917
    state: Any, spring: Any, hz: float, first: int, feed: float, fastest: float, hardest: float
) -> None:
    """Change three components of the speed, from the first on, towards those that lead to the target."""
    size = length(spring.error, first)
    share = closing_speed(size, hardest) / max(size, _TINY)
    wanted = spring.side
    for k in range(first, first + 3):
        wanted[k] = feed * spring.feed[k] + spring.error[k] * share
    size = length(wanted, first)
    is_fast, share = size > fastest, fastest / max(size, fastest)
    for k in range(first, first + 3):
        wanted[k] = wanted[k] * share - spring.speed[k]
    size = length(wanted, first)
    flag_limits(state, spring, is_fast, size * hz > hardest)
    share = hardest / hz / max(size, hardest / hz)
    for k in range(first, first + 3):
        spring.speed[k] += wanted[k] * share


@kernel()
def closing_speed(size: float, hardest: float) -> float:
    """Return how fast a gap is closed: faster than this it could not slow down in time to stop at the target."""
    return min(_GAIN * size, math.sqrt(2 * _APPROACH * hardest * size))


@kernel()
def flag_limits(state: Any, spring: Any, is_fast: bool, is_hard: bool) -> None:
    """Note which limits were met."""
    if is_fast:
        state.limits |= _VELOCITY
    if is_hard and spring.is_active:
        state.limits |= _ACCELERATION


@kernel()
def is_equilibrium_still(spring: Any, least: float) -> bool:
    """Return whether nothing moves faster than the least [m/s, rad/s]."""
    is_still = abs(spring.opening_speed) <= least
    for k in range(6):
        is_still = is_still and abs(spring.speed[k]) <= least
    return is_still


@kernel()
def is_spring_at_rest(spring: Any) -> bool:
    """Return whether equilibrium and feed-forward are at rest, and with closed brakes whether the arm is."""
    is_free = is_equilibrium_still(spring, _REST)
    for k in range(6):
        is_free = is_free and spring.wrench[k] == 0.0
    return is_free and (spring.is_still or not spring.is_braked)


@kernel()
def length(vector: Array, first: int) -> float:
    """Return the length of three components of a vector, from the first on."""
    return math.sqrt(
        vector[first] * vector[first] + vector[first + 1] * vector[first + 1] + vector[first + 2] * vector[first + 2]
    )
