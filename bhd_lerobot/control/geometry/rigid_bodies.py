"""What a tick computes of an arm's rigid bodies: inertia, momentum, weight, and where its tool is.

Motions and forces of a link are six numbers each, about the origin of the base frame: the angular velocity and the
velocity of the point that is at the origin; the moment about the origin and the force.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.control.geometry.chain import decompose, put_turn
from bhd_lerobot.control.geometry.rotations import put_quaternion
from bhd_lerobot.control.kernels import kernel

Array = NDArray[np.float64]

_GRAVITY = 9.81  # [m/s^2]


@kernel()
def find_dynamics(arm: Any, limits: Any, q: Array, speed: Array) -> None:
    """Write the dynamics of a state of an arm: mass @ change + own = torque.

    To its `mass` [kg m^2], with the rotors' inertia, upper triangle; `own`, what speeds and weight need [N m];
    `gravity`, the weight alone [N m]; `momentum`, mass @ speed; `gradient`, that of the kinetic energy by the positions
    [N m], which is the transpose of the Coriolis matrix times the speed; `jacobian`, at the tool centre point, linear
    velocity first; `tool` [m] and `tool_turn`, where that is.

    Args:
        q: positions [rad].
        speed: [rad/s].
    """
    for k in range(limits.dof):
        place_link(arm, limits, q, k)
    find_motions(arm, limits, speed)
    for k in range(limits.dof - 2, -1, -1):
        add_link(arm, k)
    for k in range(limits.dof):
        find_terms(arm, limits, speed, k)
    find_tool(arm, limits)


@kernel()
def add_link(arm: Any, k: int) -> None:
    """Add to a link what is behind its end: its joint carries all that."""
    arm.masses[k] += arm.masses[k + 1]
    for i in range(3):
        arm.firsts[k, i] += arm.firsts[k + 1, i]
        for j in range(3):
            arm.inertias[k, i, j] += arm.inertias[k + 1, i, j]
    for i in range(6):
        arm.momenta[k, i] += arm.momenta[k + 1, i]
        arm.pulls[k, i] += arm.pulls[k + 1, i]


@kernel()
def find_tool(arm: Any, limits: Any) -> None:
    """Write where the tool is, and how it moves with the joints."""
    last = limits.dof - 1
    rotation, turn = arm.rotations[last], arm.turns[last]
    for i in range(3):
        arm.tool[i] = arm.origins[last, i]
        for j in range(3):
            arm.tool[i] += rotation[i, j] * limits.tool_offset[j]
            turn[i, j] = 0.0
            for m in range(3):
                turn[i, j] += rotation[i, m] * limits.tool_turn[m, j]
    put_quaternion(arm.tool_turn, turn)
    for k in range(limits.dof):
        axis, origin = arm.axes[k], arm.origins[k]
        x, y, z = arm.tool[0] - origin[0], arm.tool[1] - origin[1], arm.tool[2] - origin[2]
        column = cross(axis[0], axis[1], axis[2], x, y, z)
        for i in range(3):
            arm.jacobian[i, k], arm.jacobian[i + 3, k] = column[i], axis[i]


@kernel()
def place_link(arm: Any, limits: Any, q: Array, k: int) -> None:
    """Write where a link and its joint are, and its inertia about the origin."""
    rotation, origin, turn, offset = arm.rotations[k], arm.origins[k], arm.turns[k], limits.offset[k]
    put_turn(turn, limits.turn[k], limits.axis[k], q[k])
    for i in range(3):
        origin[i] = offset[i]
        for j in range(3):
            rotation[i, j] = turn[i, j]
        if k > 0:
            before = arm.rotations[k - 1]
            origin[i] = arm.origins[k - 1, i]
            for j in range(3):
                origin[i] += before[i, j] * offset[j]
                rotation[i, j] = before[i, 0] * turn[0, j] + before[i, 1] * turn[1, j] + before[i, 2] * turn[2, j]
    axis, first, inertia = arm.axes[k], arm.firsts[k], arm.inertias[k]
    mass, square = limits.mass[k], 0.0
    for i in range(3):
        axis[i], first[i] = 0.0, origin[i]
        for j in range(3):
            axis[i] += rotation[i, j] * limits.axis[k, j]
            first[i] += rotation[i, j] * limits.centre[k, j]
        square += first[i] * first[i]
    lever = cross(origin[0], origin[1], origin[2], axis[0], axis[1], axis[2])
    for i in range(3):
        arm.levers[k, i] = lever[i]
        for j in range(3):
            total = mass * ((square if i == j else 0.0) - first[i] * first[j])
            for m in range(3):
                for n in range(3):
                    total += rotation[i, m] * limits.inertia[k, m, n] * rotation[j, n]
            inertia[i, j] = total
    for i in range(3):
        first[i] *= mass
    arm.masses[k] = mass


@kernel()
def find_motions(arm: Any, limits: Any, speed: Array) -> None:
    """Write each link's motion, momentum, and the force that it needs with joints that keep their speeds."""
    wx = wy = wz = ux = uy = uz = 0.0  # motion
    ax = ay = az = bx = by = 0.0  # its change: a base that accelerates upwards stands for the weight
    bz = _GRAVITY
    for k in range(limits.dof):
        axis, lever, first, inertia, mass = arm.axes[k], arm.levers[k], arm.firsts[k], arm.inertias[k], arm.masses[k]
        sx, sy, sz = axis[0] * speed[k], axis[1] * speed[k], axis[2] * speed[k]
        tx, ty, tz = lever[0] * speed[k], lever[1] * speed[k], lever[2] * speed[k]
        x, y, z = cross(wx, wy, wz, sx, sy, sz)
        ax, ay, az = ax + x, ay + y, az + z
        x, y, z = cross(wx, wy, wz, tx, ty, tz)
        bx, by, bz = bx + x, by + y, bz + z
        x, y, z = cross(ux, uy, uz, sx, sy, sz)
        bx, by, bz = bx + x, by + y, bz + z
        wx, wy, wz, ux, uy, uz = wx + sx, wy + sy, wz + sz, ux + tx, uy + ty, uz + tz
        rates, momentum, pull = arm.rates[k], arm.momenta[k], arm.pulls[k]
        rates[0], rates[1], rates[2], rates[3], rates[4], rates[5] = wx, wy, wz, ux, uy, uz
        put_wrench(momentum, mass, first, inertia, wx, wy, wz, ux, uy, uz)
        put_wrench(pull, mass, first, inertia, ax, ay, az, bx, by, bz)
        turning = cross(wx, wy, wz, momentum[0], momentum[1], momentum[2])
        moving = cross(ux, uy, uz, momentum[3], momentum[4], momentum[5])
        pushing = cross(wx, wy, wz, momentum[3], momentum[4], momentum[5])
        for i in range(3):
            pull[i] += turning[i] + moving[i]
            pull[i + 3] += pushing[i]


@kernel()
def put_wrench(  # noqa: PLR0917
    wrench: Array,
    mass: float,
    first: Array,
    inertia: Array,
    wx: float,
    wy: float,
    wz: float,
    ux: float,
    uy: float,
    uz: float,
) -> None:
    """Write the product of an inertia and a motion."""
    moment, force = cross(first[0], first[1], first[2], ux, uy, uz), cross(wx, wy, wz, first[0], first[1], first[2])
    for i in range(3):
        wrench[i] = inertia[i, 0] * wx + inertia[i, 1] * wy + inertia[i, 2] * wz + moment[i]
        wrench[i + 3] = force[i]
    wrench[3] += mass * ux
    wrench[4] += mass * uy
    wrench[5] += mass * uz


@kernel()
def find_terms(arm: Any, limits: Any, speed: Array, k: int) -> None:
    """Write what a joint has of mass matrix, momentum, its gradient and weight."""
    axis, lever, first, rates = arm.axes[k], arm.levers[k], arm.firsts[k], arm.rates[k]
    momentum, pull, room = arm.momenta[k], arm.pulls[k], arm.side
    turning = cross(rates[0], rates[1], rates[2], axis[0], axis[1], axis[2])
    moving = cross(rates[3], rates[4], rates[5], axis[0], axis[1], axis[2])
    pushing = cross(rates[0], rates[1], rates[2], lever[0], lever[1], lever[2])
    arm.momentum[k], arm.own[k], arm.gradient[k] = limits.rotor[k] * speed[k], 0.0, 0.0
    for i in range(3):
        arm.momentum[k] += axis[i] * momentum[i] + lever[i] * momentum[i + 3]
        arm.own[k] += axis[i] * pull[i] + lever[i] * pull[i + 3]
        arm.gradient[k] += turning[i] * momentum[i] + (pushing[i] + moving[i]) * momentum[i + 3]
    arm.gravity[k] = _GRAVITY * (axis[0] * first[1] - axis[1] * first[0] + lever[2] * arm.masses[k])
    x, y, z, u, v, w = axis[0], axis[1], axis[2], lever[0], lever[1], lever[2]
    put_wrench(room, arm.masses[k], first, arm.inertias[k], x, y, z, u, v, w)
    for j in range(k + 1):
        arm.mass[j, k] = limits.rotor[k] if j == k else 0.0
        for i in range(3):
            arm.mass[j, k] += arm.axes[j, i] * room[i] + arm.levers[j, i] * room[i + 3]


@kernel()
def find_mobility(arm: Any, limits: Any, damping: float) -> None:
    """Write the inverse of the inertia that a wrench on the tool moves to `mobility`, from mass and Jacobian.

    The mass matrix is lost. Where the Jacobian is singular, so is the mobility: what cannot move weighs for ever.

    Args:
        damping: what is added to its diagonal [1/kg, 1/(kg m^2)], so that it can be inverted near a singularity.
    """
    mass, columns = arm.mass, arm.columns
    for i in range(limits.dof):
        for j in range(i):
            mass[i, j] = mass[j, i]
    decompose(mass, limits.dof)
    for row in range(6):
        for i in range(limits.dof):
            total = arm.jacobian[row, i]
            for k in range(i):
                total -= mass[i, k] * columns[k, row]
            columns[i, row] = total / mass[i, i]
    for i in range(6):
        for j in range(i + 1):
            total = damping if i == j else 0.0
            for k in range(limits.dof):
                total += columns[k, i] * columns[k, j]
            arm.mobility[i, j] = arm.mobility[j, i] = total


@kernel()
def cross(ax: float, ay: float, az: float, bx: float, by: float, bz: float) -> tuple[float, float, float]:  # noqa: PLR0917
    """Return the cross product of two vectors."""
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
