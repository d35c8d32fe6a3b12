"""How hard an arm presses, from its motors' efforts: what it may do no more than for a moment.

The motors' efforts, averaged over 20 ms, are compared with those that the motion of that time needs, and explained by a
force on the tool, and by a force with a moment; the larger force counts. Of a force on the tool 98 % are found in the
median, and 71 % in 99 of 100 postures and directions. A force elsewhere on the arm counts with the force on the tool
that would load the joints alike: half-way to the tool, about half of it is felt. What is not modelled counts too:
friction, and the weight of a load that was not declared. Of that no more than 20 N is permitted: an arm at rest whose
tool is pulled down by more has another load than its motions were planned with.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Arm, Body
from bhd_lerobot.control.geometry.chain import find_jacobian, find_torques, solve
from bhd_lerobot.control.kernels import kernel
from bhd_lerobot.errors import ConfigError

Array = NDArray[np.float64]

_PERIOD_S = 0.02  # between two estimates
_SHARE = 0.7  # of what is new in an estimate: one reading's noise must not be a force
# Directions in which a singular posture feels little are left out: errors of the joints' torques, such as 16 N m in the
# hardest reversals of a simulated UR5, would be large forces there. A force with a lever of 0.2 m is felt to 80 %.
_DAMPING = 0.1
# A load that was not declared hangs on the tool: the force on it points down, at rest, for so long.
_LOAD_N, _LOAD_S = 20.0, 0.3
_DOWN = 0.9  # the least cosine between that force and the vertical
_STILL = 0.02  # [rad/s]
_GRAVITY = 9.81  # [m/s^2]
# A force alone, without a moment, is found in more directions: in those in which the strongest motors feel it with a
# lever of less than 0.1 m, by less than half.
_FORCE_DAMPING = 0.1
_LEAST_TORQUE = 4.0  # [N m] where no joint feels more, nothing is estimated: 10 N with a lever of 0.4 m
# Efforts that are all exactly 0 are none that were measured: motors that carry this much [N m] give some.
_CARRIES = 4.0
_LOST_S = 0.1  # without any effort that was measured


def put_force_limit(row: Any, body: Body, control_hz: int, largest: float, *, wrench: bool) -> None:
    """Write into a record of `ARM_LIMITS` with what an arm may press.

    Args:
        control_hz: ticks a second [Hz].
        largest: force with which the tool may press [N].
        wrench: estimate also the wrench on the tool.

    Raises:
        ConfigError: the largest force is not positive.
    """
    from bhd_lerobot.control.geometry.dynamics import ArmDynamics  # Pinocchio, which every tick does without

    if not largest > 0.0:
        raise ConfigError(f"max_force is {largest}; it must be positive [N]. With .inf nothing is too much.")
    period = max(1, round(_PERIOD_S * control_hz))
    row["feels"], row["has_wrench"], row["most_force"] = True, wrench, largest
    row["felt_ticks"], row["felt_hz"], row["most_hung"] = period, control_hz / period, round(_LOAD_S / _PERIOD_S)
    row["most_lost"] = max(1, round(_LOST_S * control_hz / period))
    dynamics = ArmDynamics(body)
    dof = dynamics.dof
    effort = np.asarray(body.need(Arm).limits.effort[:dof])
    row["certain"][:dof] = effort.max() / effort  # weights: torques are as wrong as their motors are large
    dynamics.fill(row)


def explain_force(body: Body, arm: Any, limits: Any) -> str:
    """Return as text which force of an arm was too large."""
    if arm["hung"] >= limits["most_hung"]:
        load = body.need(Arm).load
        return (
            f"About {load + arm['pull'] / _GRAVITY:.1f} kg hang on the tool, or it presses upwards; "
            f"declared are {load:g} kg. Declare what it carries with robot.payload."
        )
    return (
        f"The tool pressed with {arm['force']:.0f} N; {limits['most_force']:g} N is the most. Find out what is in its "
        "way, or allow more with robot.max_force."
    )


def forget_force(state: Any, arm: Any) -> None:
    """Forget what an arm felt: it was somewhere else."""
    for name in ("hung", "zeros", "force", "pressing", "presses"):
        arm[name] = 0
    for name in ("sum", "torque"):
        arm[name][:] = 0.0
    state["wrench"][:] = 0.0
    arm["is_fresh"] = True


@kernel()
def feel(state: Any, arm: Any, limits: Any, geometry: Any) -> bool:
    """Take one tick into account; return whether there is a new estimate that is too large.

    To the arm's `force` [N], 0 where the joints feel too little to ask, `torque`, what the motors give more than the
    posture and its motion need [N m], and `pressing`, the force that is more than a load which need not be declared
    [N]; to the robot's `wrench` what the surroundings put on the tool, in the base frame, if it is asked for [N, N m].
    """
    if not state.has_effort:
        arm.is_measured = False
        return False
    is_none = True
    for k in range(limits.dof):
        arm.sum[k] += state.effort[k]
        is_none = is_none and state.effort[k] == 0.0
    arm.zeros += is_none
    arm.ticks += 1
    if arm.ticks < limits.felt_ticks:
        return False
    find_residual(state, arm, limits)
    for k in range(limits.dof):
        # What is felt, found again as what it needs of motors.
        arm.torque[k] += _SHARE * (arm.needs[k] - arm.torque[k])
    if limits.has_wrench:
        find_jacobian(arm, geometry, arm.felt_position)
        find_wrench(arm, limits)
        for k in range(6):
            state.wrench[k] = -arm.side[k]
    find_force(arm, limits, geometry)
    return arm.presses


@kernel()
def find_residual(state: Any, arm: Any, limits: Any) -> None:
    """Write what the motors gave in this period more than its motion needs to the arm's `needs` [N m].

    Where nothing was measured it is what it was.
    """
    is_resting = arm.rest_ticks > 0  # whatever speeds are read
    for k in range(limits.dof):
        # The joint of a wrong encoder is where its servo was commanded to hold it.
        position = state.command[k] if arm.wrong[k] != 0 else state.position[k]
        velocity = state.velocity[k]
        arm.room[0, k] = (position + arm.felt_position[k]) / 2
        arm.room[1, k] = 0.0 if is_resting else (velocity + arm.felt_velocity[k]) / 2
        arm.room[2, k] = 0.0 if is_resting else (velocity - arm.felt_velocity[k]) * limits.felt_hz
        arm.felt_position[k], arm.felt_velocity[k] = position, velocity
    find_torques(arm, limits, arm.room[0], arm.room[1], arm.room[2])
    given_ticks = max(arm.ticks - arm.zeros, 1)
    for k in range(limits.dof):
        # Where it came from is not known yet.
        arm.needs[k] = 0.0 if arm.is_fresh else arm.sum[k] / given_ticks - arm.needs[k]
        arm.sum[k] = 0.0
    is_none = arm.zeros == arm.ticks
    arm.is_fresh, arm.ticks, arm.zeros = False, 0, 0
    arm.is_lost = False
    if not is_none:
        arm.lost_periods, arm.is_measured = 0, True
        return
    arm.lost_periods += 1
    if arm.lost_periods >= limits.most_lost:
        arm.is_measured = False
        for k in range(limits.dof):
            arm.room[0, k] = 0.0
        find_torques(arm, limits, arm.felt_position, arm.room[0], arm.room[0])
        for k in range(limits.dof):
            arm.is_lost = arm.is_lost or abs(arm.needs[k]) > _CARRIES
    for k in range(limits.dof):
        if not arm.is_measured:
            arm.torque[k] = 0.0
        arm.needs[k] = arm.torque[k]


@kernel()
def find_wrench(arm: Any, limits: Any) -> None:
    """Write the force and moment on the tool that torques amount to, by damped least squares, to the arm's `side`.

    Near zero in directions that a singular posture can feel nothing from.
    """
    for i in range(6):
        arm.side[i] = 0.0
        for j in range(i + 1):
            arm.square[i, j] = _DAMPING * _DAMPING if i == j else 0.0
        for k in range(limits.dof):
            arm.side[i] += arm.jacobian[i, k] * arm.torque[k]
            for j in range(i + 1):
                arm.square[i, j] += arm.jacobian[i, k] * arm.jacobian[j, k]
    solve(arm.square, arm.side, 6)


@kernel()
def find_lone_force(arm: Any, limits: Any) -> None:
    """Write the force on the tool alone, without a moment, that torques amount to [N], to the arm's `side`."""
    for i in range(3):
        arm.side[i] = 0.0
        for j in range(i + 1):
            arm.square[i, j] = _FORCE_DAMPING * _FORCE_DAMPING if i == j else 0.0
        for k in range(limits.dof):
            certain = limits.certain[k] * limits.certain[k]
            arm.side[i] += arm.jacobian[i, k] * arm.torque[k] * certain
            for j in range(i + 1):
                arm.square[i, j] += arm.jacobian[i, k] * arm.jacobian[j, k] * certain
    solve(arm.square, arm.side, 3)


@kernel()
def length(vector: Array) -> float:
    """Return the length of a vector; ``x ** 2`` is a call of pow in Python, and rounds otherwise than x * x."""
    return math.sqrt(vector[0] * vector[0] + vector[1] * vector[1] + vector[2] * vector[2])


@kernel()
def find_force(arm: Any, limits: Any, geometry: Any) -> None:
    """Find the force with which an arm presses, and whether that is too much."""
    arm.force = arm.pressing = arm.pull = 0.0
    arm.presses = False
    felt, is_still = 0.0, True
    for k in range(limits.dof):
        felt = max(felt, abs(arm.torque[k]))
        is_still = is_still and abs(arm.felt_velocity[k]) < _STILL
    if felt <= _LEAST_TORQUE:
        arm.hung = 0
        return
    find_jacobian(arm, geometry, arm.felt_position)
    find_wrench(arm, limits)
    size, arm.pull = length(arm.side), arm.side[2]
    find_lone_force(arm, limits)
    alone = length(arm.side)
    arm.force = max(size, alone)
    if alone >= size:
        arm.pull = arm.side[2]  # the tool pulls it up
    is_up = arm.pull > _DOWN * arm.force
    arm.pressing = 0.0 if is_up and arm.force < _LOAD_N else arm.force
    arm.hung = arm.hung + 1 if is_up and arm.pull > _LOAD_N and is_still else 0
    arm.presses = arm.force > limits.most_force or arm.hung >= limits.most_hung
