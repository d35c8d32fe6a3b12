"""What a tick does for an arm with torque motors: a spring and a damper between its tool and an equilibrium."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.control.arm.compliance import find_damping
from bhd_lerobot.control.arm.equilibrium import (
    SPEED,
    TURN_SPEED,
    head_for_setpoint,
    keep_near,
    length,
    move_equilibrium,
    put_at_tool,
)
from bhd_lerobot.control.arm.wrench import observe_contact
from bhd_lerobot.control.geometry.chain import find_torques
from bhd_lerobot.control.geometry.rigid_bodies import find_dynamics, find_mobility
from bhd_lerobot.control.geometry.rotations import find_way
from bhd_lerobot.control.guard import FULL_TORQUE_S
from bhd_lerobot.control.kernels import clamp, kernel
from bhd_lerobot.control.messages import Limit, Mode, Watchdog

Array = NDArray[np.float64]

_JOINT_DAMPING = 0.01  # [s/rad] share of a joint's largest torque that brakes it at 1 rad/s, in every posture
_FORCE_RATE, _MOMENT_RATE = 100.0, 20.0  # [N/s, N m/s] of the feed-forward wrench
_MOBILITY_DAMPING = 1e-3  # [1/kg, 1/(kg m^2)] beside about 0.1 1/kg: no direction weighs more than 1000 kg
_STILL = 0.05  # [rad/s] the joints' speed below which a hard stop is over
_STIFFENING, _TURN_STIFFENING = 5000.0, 300.0  # [N/m/s, N m/rad/s] a spring that stiffens gains energy
# From the first speed on the spring pushes less, from the second on no more: shares of the equilibrium's largest for
# the tool, of their own for joints.
_FREE_PUSH, _FREE_TURN = 15.0, 3.0  # [N, N m] what a tool in free motion needs at most
_EASES, _ENDS = 1.0, 1.4
_JOINT_EASES, _JOINT_ENDS = 0.7, 1.0
_GAINED = 0.8  # share of the tool's largest speed that it may gain while torques fall
# A joint that turns at this speed [rad/s] one way and the other in turns, more often than every so many seconds and the
# equilibrium, is part of a loop that swings: its readings are late.
_SWING_SPEED, _SWING_S = 0.15, 0.4
_ROOM_RAD = 0.1  # so far from where a brake closed does the torque that carries the arm's weight follow the readings
_LIGHT_N = 20.0  # [N] what presses less is no obstacle to an activation
_TINY = 1e-12
_HOLD, _STOPPING = int(Mode.HOLD), int(Mode.STOPPING)
_ENTERED = tuple(int(one) for one in (Mode.STOPPING, Mode.INACTIVE, Mode.HOLD, Mode.SAFE_OFF, Mode.ESTOP, Mode.FAULT))
_EFFORT, _SPEED_STOP, _FORCE_STOP = int(Limit.EFFORT), int(Watchdog.SPEED), int(Watchdog.FORCE)
_GUARD = int(Watchdog.GUARD)


@kernel()
def tell_spring(state: Any, spring: Any, limits: Any) -> None:
    """Take the modes that a robot has entered, and its setpoint."""
    if state.goes_back:
        spring.opening, spring.opening_speed = state.written[limits.dof], 0.0
        for k in range(6):
            spring.wrench[k] = 0.0
        put_where_it_is(spring, limits)
        state.goes_back = False
    if state.entered != 0:
        for mode in _ENTERED:
            if state.entered & (1 << mode):
                stop_spring(spring, limits, mode)
        state.entered = 0
    state.is_distrusted = False
    if state.has_setpoint:
        state.has_setpoint = False
        if not head_for_setpoint(state, spring, limits):
            spring.is_refused = True


@kernel()
def stop_spring(spring: Any, limits: Any, mode: int) -> None:
    """Brake the equilibrium to rest and stay there; in a mode without motion carry the weight, and no more."""
    spring.is_active = False
    for k in range(6):
        spring.wanted_wrench[k] = 0.0
    is_braked = mode not in (_HOLD, _STOPPING)
    if is_braked == spring.is_braked:
        return
    spring.is_braked = is_braked
    for k in range(limits.dof):
        spring.carried[k], spring.swings[k] = spring.position[k], 0.0
    for k in range(limits.dof + 6):
        spring.swung[k] = 0.0
    put_where_it_is(spring, limits)


@kernel()
def put_where_it_is(spring: Any, limits: Any) -> None:
    """Put the equilibrium where the tool was read last."""
    find_dynamics(spring, limits, spring.position, spring.still)
    put_at_tool(spring)


@kernel()
def move_spring(state: Any, spring: Any, limits: Any) -> None:
    """Advance an impedance by one tick, up to what is to be written."""
    dof, speed = limits.dof, state.velocity
    for k in range(dof):
        spring.position[k] = state.position[k]
        if spring.is_fresh:  # where the arm was put, its weight is carried
            spring.carried[k] = state.position[k]
    find_dynamics(spring, limits, state.position, speed)
    observe_contact(state, spring, limits)
    for i in range(6):
        spring.tool_speed[i] = 0.0
        for k in range(dof):
            spring.tool_speed[i] += spring.jacobian[i, k] * speed[k]
    state.protective_stop = _GUARD if spring.is_refused else supervise_spring(state, spring, limits)
    spring.is_refused = False
    change_stiffness(spring, limits)
    move_equilibrium(state, spring, limits)
    move_wrench(spring, limits)
    find_wanted_torques(state, spring, limits, speed)
    if spring.is_braked:
        for k in range(dof):
            spring.near[k] = clamp(state.position[k], spring.carried[k] - _ROOM_RAD, spring.carried[k] + _ROOM_RAD)
        find_torques(spring, limits, spring.near, spring.still, spring.still)
        for k in range(dof):
            spring.wanted[k] = spring.needs[k]
    is_limited, spring.is_still = False, True
    for k in range(dof):
        before, step = state.written[k], limits.effort[k] / (FULL_TORQUE_S * limits.hz)
        given = clamp(clamp(spring.wanted[k], before - step, before + step), -limits.effort[k], limits.effort[k])
        is_limited = is_limited or given != spring.wanted[k]
        state.actuators[k] = given
        spring.is_still = spring.is_still and abs(speed[k]) < _STILL
    state.actuators[dof] = spring.opening
    if is_limited:
        state.limits |= _EFFORT
    publish_equilibrium(state, spring)


@kernel()
def publish_equilibrium(state: Any, spring: Any) -> None:
    """Write what is applied."""
    put_pose(state.command, spring.place, spring.turn)
    state.command[7] = spring.opening


@kernel()
def put_pose(values: Array, place: Array, turn: Array) -> None:
    """Write a position and a quaternion, as the one of both signs that is on the side of the tool that points down."""
    side = turn[1]
    for k in range(4):
        if side == 0.0:
            side = turn[k]
    sign = -1.0 if side < 0.0 else 1.0
    for k in range(3):
        values[k] = place[k]
    for k in range(4):
        values[3 + k] = sign * turn[k]


@kernel()
def report_spring(state: Any, spring: Any, limits: Any) -> None:
    """Write where the tool was read, the torques of the motors, and with what it presses, to the record."""
    dof = limits.dof
    put_pose(state.measured, spring.tool, spring.tool_turn)
    state.measured[7] = state.position[dof]
    for k in range(dof + 1):
        state.torque[k] = state.effort[k] if state.has_effort else state.written[k]
    if not state.has_effort:
        servo = limits.stiffness[dof] * (state.written[dof] - state.position[dof])
        state.torque[dof] = servo - limits.damping[dof] * state.velocity[dof]
    force = length(state.wrench, 0)
    state.pressed = force if spring.is_still and force > _LIGHT_N else 0.0


@kernel()
def supervise_spring(state: Any, spring: Any, limits: Any) -> int:
    """Return why an arm is to stop, as a `Watchdog` flag: it is too fast, or in too hard a contact; 0 if it is not."""
    dof, speed = limits.dof, state.velocity
    is_fast = length(spring.tool_speed, 0) > limits.most_tool_speed[0]
    is_fast = is_fast or length(spring.tool_speed, 3) > limits.most_tool_speed[1]
    is_hard = length(state.wrench, 0) > limits.most_force
    decay = 1.0 / (_SWING_S * limits.hz)
    for k in range(6):
        decay += note_direction(spring, dof + k, spring.speed[k])
    decay = min(decay, 1.0 + 1.0 / (_SWING_S * limits.hz))
    for k in range(dof):
        turned = note_direction(spring, k, speed[k] if abs(speed[k]) > _SWING_SPEED else 0.0)
        spring.swings[k] = max(spring.swings[k] - decay, 0.0) + turned
        is_fast = is_fast or abs(speed[k]) > limits.most_speed[k] or spring.swings[k] > limits.most_swings
        is_hard = is_hard or abs(spring.torque[k]) > limits.most_torque[k]
    if spring.is_braked:
        return 0
    return (_SPEED_STOP if is_fast else 0) | (_FORCE_STOP if is_hard else 0)


@kernel()
def note_direction(spring: Any, place: int, speed: float) -> float:
    """Return 1 if what moved one way before moves the other way now, otherwise 0."""
    if speed == 0.0:
        return 0.0
    direction = 1.0 if speed > 0.0 else -1.0
    turned = 1.0 if direction * spring.swung[place] < 0.0 else 0.0
    spring.swung[place] = direction
    return turned


@kernel()
def change_stiffness(spring: Any, limits: Any) -> None:
    """Move the stiffness towards what is wanted, all its parts alike."""
    most = 1.0
    for i in range(6):
        for j in range(6):
            change = abs(spring.wanted_stiffness[i, j] - spring.stiffness[i, j])
            if change != 0.0:
                one, other = (_STIFFENING if i < 3 else _TURN_STIFFENING), (_STIFFENING if j < 3 else _TURN_STIFFENING)
                most = max(most, change * limits.hz / math.sqrt(one * other))
    for i in range(6):
        for j in range(6):
            spring.stiffness[i, j] += (spring.wanted_stiffness[i, j] - spring.stiffness[i, j]) / most


@kernel()
def move_wrench(spring: Any, limits: Any) -> None:
    """Move the feed-forward wrench towards what is wanted; none without setpoints, none at once if braked."""
    for k in range(6):
        step = (_FORCE_RATE if k < 3 else _MOMENT_RATE) / limits.hz
        wanted = spring.wanted_wrench[k] if spring.is_active else 0.0
        spring.wrench[k] = 0.0 if spring.is_braked else spring.wrench[k] + clamp(wanted - spring.wrench[k], -step, step)


@kernel()
def find_wanted_torques(state: Any, spring: Any, limits: Any, speed: Array) -> None:
    """Write the torques of spring, damper and feed-forward, and of the arm's own dynamics, to the spring's `wanted`."""
    dof, push = limits.dof, spring.push
    find_mobility(spring, limits, _MOBILITY_DAMPING)
    find_push(spring)
    limit_push(state, spring, share_to_stop(spring, limits))
    if spring.is_fixed:
        limit_lead(state, spring)
    else:
        find_damping(spring)
    damping = spring.fixed_damping if spring.is_fixed else spring.damping
    for i in range(6):
        for j in range(6):
            push[i] += damping[i, j] * (spring.lead[j] - spring.tool_speed[j])
    share = 1.0
    for k in range(dof):
        torque = spring.wanted[k] = pull_of(spring, k)
        along = speed[k] if torque > 0.0 else -speed[k] if torque < 0.0 else 0.0
        most = limits.fastest[k]
        share = min(share, clamp((_JOINT_ENDS * most - along) / ((_JOINT_ENDS - _JOINT_EASES) * most), 0.0, 1.0))
    for k in range(dof):
        damper = _JOINT_DAMPING * limits.effort[k] * speed[k]
        spring.wanted[k] = spring.wanted[k] * share + spring.own[k] - damper


@kernel()
def share_to_stop(spring: Any, limits: Any) -> float:
    """Return the share of the push with which the tool gains no more than its speed while the torques fall.

    What is pressed may give way at once, and the motors' torques need their time to fall.
    """
    fall_s = 0.0
    for k in range(limits.dof):
        fall_s = max(fall_s, abs(pull_of(spring, k)) * (FULL_TORQUE_S / limits.effort[k]))
    for i in range(6):
        spring.side[i] = 0.0
        for j in range(6):
            spring.side[i] += spring.mobility[i, j] * spring.push[j] * (0.5 * fall_s)
    gained = max(length(spring.side, 0) / (_GAINED * SPEED), length(spring.side, 3) / (_GAINED * TURN_SPEED))
    return 1.0 / math.sqrt(max(gained, 1.0))


@kernel()
def limit_push(state: Any, spring: Any, share: float) -> None:
    """Push no more than a share, than the largest force and moment, and than the tool's speed permits."""
    for part in range(2):
        remains = spring.tethers[part] * share
        keep_near(spring, part, remains)
        size, largest = length(spring.push, 3 * part), spring.largest[part]
        if remains < 1.0 or size > largest:
            state.limits |= _EFFORT
        # The faster the tool moves where it is pushed to, the less it is pushed.
        most, ahead = TURN_SPEED if part else SPEED, 0.0
        for k in range(3 * part, 3 * part + 3):
            ahead += spring.push[k] * spring.tool_speed[k]
        ahead /= max(size, _TINY)
        least = min(_FREE_TURN if part else _FREE_PUSH, largest)
        least *= clamp((_ENDS * most - ahead) / ((_ENDS - _EASES) * most), 0.0, 1.0)
        allowed = min(clamp(largest * (1.0 - ahead / (_EASES * most)), least, largest), size * share)
        for k in range(3 * part, 3 * part + 3):
            spring.push[k] *= allowed / max(size, _TINY)


@kernel()
def limit_lead(state: Any, spring: Any) -> None:
    """Let a damping that was given pull the tool along with the equilibrium by no more than the push leaves.

    Beside what it takes from the tool's own speed: of the largest force and moment, or what free motion needs.
    """
    share = 1.0
    for part in range(2):
        pulls = drags = 0.0
        for i in range(3 * part, 3 * part + 3):
            pull = drag = 0.0
            for j in range(6):
                pull += spring.fixed_damping[i, j] * spring.lead[j]
                drag += spring.fixed_damping[i, j] * spring.tool_speed[j]
            pulls, drags = pulls + pull * pull, drags + pull * drag
        size = max(math.sqrt(pulls), _TINY)
        left = max(spring.largest[part] - length(spring.push, 3 * part), _FREE_TURN if part else _FREE_PUSH)
        share = min(share, (left + max(drags / size, 0.0)) / size)
    if share < 1.0:
        state.limits |= _EFFORT
    for k in range(6):
        spring.lead[k] *= share


@kernel()
def find_push(spring: Any) -> None:
    """Write what spring and feed-forward push with, and the equilibrium's speed as far as the damper counts it.

    The damper's pull by the equilibrium's speed ends where the spring's is the largest. The `tethers` are the shares of
    the way to the equilibrium at which the spring pushes its most.
    """
    push, lead, error = spring.push, spring.lead, spring.error
    find_way(error[3:], spring.turn, spring.tool_turn)
    for k in range(3):
        error[k] = spring.place[k] - spring.tool[k]
    for i in range(6):
        push[i], lead[i] = 0.0, spring.speed[i]
        for j in range(6):
            push[i] += spring.stiffness[i, j] * error[j]
    for part in range(2):
        size, largest = length(push, 3 * part), spring.largest[part]
        tether = spring.tethers[part] = largest / max(size, largest)
        for k in range(3 * part, 3 * part + 3):
            lead[k] *= clamp(2.0 * (1.0 - size / largest), 0.0, 1.0)
            push[k] = push[k] * tether + spring.wrench[k]


@kernel()
def pull_of(spring: Any, k: int) -> float:
    """Return the torque of a joint that the push on the tool amounts to [N m]."""
    total = 0.0
    for i in range(6):
        total += spring.jacobian[i, k] * spring.push[i]
    return total
