"""What a tick computes of one serial arm: frames, distances, Jacobian, inverse dynamics, least squares.

The arrays that they need are in the arm's record.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.control.kernels import clamp, kernel

Array = NDArray[np.float64]

_TINY = 1e-12  # [m^2]; keeps the divisions of capsules without length finite
_GRAVITY = 9.81  # [m/s^2]


@kernel()
def sine_and_cosine(angle: float) -> tuple[float, float]:
    """Return both; no numbers of an infinity, for which Python raises."""
    angle = angle if math.isfinite(angle) else math.nan
    return math.sin(angle), math.cos(angle)


@kernel()
def find_frames(arm: Any, geometry: Any, q: Array) -> None:
    """Write the frame behind each joint in a posture, in the base frame; the first is the base frame."""
    for i in range(3):
        for j in range(4):
            arm.frames[0, i, j] = 1.0 if i == j else 0.0
    for k in range(geometry.dof):
        s, c = sine_and_cosine(q[k])
        before, after, link = turned_in(arm, geometry, k), arm.frames[k + 1], geometry.link[k]
        for i in range(3):
            x, y, z = before[i, 0], before[i, 1], before[i, 2]
            ahead, across = c * x + s * y, c * y - s * x
            for j in range(3):
                after[i, j] = link[0, j] * ahead + link[1, j] * across + link[2, j] * z
            after[i, 3] = before[i, 3] + link[0, 3] * ahead + link[1, 3] * across + link[2, 3] * z


@kernel()
def turned_in(arm: Any, geometry: Any, joint: int) -> Array:
    """Return the frame about whose z axis a joint turns."""
    return geometry.base[0] if joint == 0 else arm.frames[joint]


@kernel()
def find_distances(arm: Any, geometry: Any, q: Array, keep: bool) -> tuple[float, float]:
    """Return the smallest distance of a posture from itself and from the table [m], infinite if nothing is checked.

    Args:
        q: the posture [rad].
        keep: write each distance to the arm's `distances`, too.
    """
    find_frames(arm, geometry, q)
    itself = table = math.inf
    for k in range(geometry.shapes):
        frame = arm.frames[geometry.frame[k]]
        for i in range(3):
            at, along = frame[i, 3], 0.0
            for j in range(3):
                at += frame[i, j] * geometry.start[k, j]
                along += frame[i, j] * geometry.way[k, j]
            arm.starts[k, i], arm.along[k, i] = at, along
        low = arm.starts[k, 2] - geometry.below_start[k]
        height = min(low, arm.starts[k, 2] + arm.along[k, 2] - geometry.below_end[k])
        table = min(table, height)
        if keep:
            arm.distances[geometry.pairs + k] = height
    for k in range(geometry.pairs):
        distance = between(arm, geometry, geometry.first[k], geometry.second[k]) - geometry.radii[k]
        itself = min(itself, distance)
        if keep:
            arm.distances[k] = distance
    return itself, table


@kernel()
def between(arm: Any, geometry: Any, one: int, other: int) -> float:
    """Return the distance between the axes of two capsules [m].

    The first guess, the closest points of the two lines, is poor for segments that are nearly parallel; it need not be
    good, because each segment then gives its closest point to the other's, and for parallel segments any guess will do.
    """
    across = off1 = off2 = 0.0
    for i in range(3):
        apart = arm.starts[one, i] - arm.starts[other, i]
        across += arm.along[one, i] * arm.along[other, i]
        off1 += arm.along[one, i] * apart
        off2 += arm.along[other, i] * apart
    square1, square2 = geometry.long[one], geometry.long[other]
    room = max(square1 * square2 - across * across, _TINY * square1 * square2)
    share1 = clamp((across * off2 - off1 * square2) / room, 0.0, 1.0)
    share2 = clamp((across * share1 + off2) / square2, 0.0, 1.0)
    share1 = clamp((across * share2 - off1) / square1, 0.0, 1.0)
    total = 0.0
    for i in range(3):
        gap = arm.starts[one, i] - arm.starts[other, i] + share1 * arm.along[one, i] - share2 * arm.along[other, i]
        total += gap * gap
    return math.sqrt(total)


@kernel()
def find_jacobian(arm: Any, geometry: Any, q: Array) -> None:
    """Write the geometric Jacobian at the tool centre point, linear velocity first, in the base frame."""
    find_frames(arm, geometry, q)
    last, jacobian = arm.frames[geometry.dof], arm.jacobian
    for k in range(geometry.dof):
        frame = turned_in(arm, geometry, k)
        for row in range(3):
            i, j = (row + 1) % 3, (row + 2) % 3
            arms = arm.side
            for at in range(3):
                tip = last[at, 3]
                for axis in range(3):
                    tip += last[at, axis] * geometry.tool[axis, 3]
                arms[at] = tip - frame[at, 3]
            jacobian[row, k] = frame[i, 2] * arms[j] - frame[j, 2] * arms[i]
            jacobian[row + 3, k] = frame[row, 2]


@kernel()
def find_torques(arm: Any, limits: Any, q: Array, speed: Array, change: Array) -> None:
    """Write what a motion needs of the motors, weight included, to the arm's `needs` [N m]: recursive Newton-Euler.

    Args:
        q: positions [rad].
        speed: [rad/s].
        change: [rad/s^2].
    """
    # Of the link before, in its frame: angular velocity, its change, and the linear acceleration of its origin.
    wx = wy = wz = ax = ay = az = lx = ly = 0.0
    lz = _GRAVITY
    for k in range(limits.dof):
        turn, axis, offset, centre = arm.turns[k], limits.axis[k], limits.offset[k], limits.centre[k]
        put_turn(turn, limits.turn[k], axis, q[k])
        # The origin's acceleration in the frame of the link before.
        cx, cy, cz = wy * offset[2] - wz * offset[1], wz * offset[0] - wx * offset[2], wx * offset[1] - wy * offset[0]
        lx += ay * offset[2] - az * offset[1] + wy * cz - wz * cy
        ly += az * offset[0] - ax * offset[2] + wz * cx - wx * cz
        lz += ax * offset[1] - ay * offset[0] + wx * cy - wy * cx
        wx, wy, wz = back(turn, 0, wx, wy, wz), back(turn, 1, wx, wy, wz), back(turn, 2, wx, wy, wz)
        ax, ay, az = back(turn, 0, ax, ay, az), back(turn, 1, ax, ay, az), back(turn, 2, ax, ay, az)
        lx, ly, lz = back(turn, 0, lx, ly, lz), back(turn, 1, lx, ly, lz), back(turn, 2, lx, ly, lz)
        sx, sy, sz = axis[0] * speed[k], axis[1] * speed[k], axis[2] * speed[k]
        ax += wy * sz - wz * sy + axis[0] * change[k]
        ay += wz * sx - wx * sz + axis[1] * change[k]
        az += wx * sy - wy * sx + axis[2] * change[k]
        wx, wy, wz = wx + sx, wy + sy, wz + sz
        # Force and moment that move the link.
        cx, cy, cz = wy * centre[2] - wz * centre[1], wz * centre[0] - wx * centre[2], wx * centre[1] - wy * centre[0]
        force, moment, mass, inertia = arm.forces[k], arm.moments[k], limits.mass[k], limits.inertia[k]
        force[0] = mass * (lx + ay * centre[2] - az * centre[1] + wy * cz - wz * cy)
        force[1] = mass * (ly + az * centre[0] - ax * centre[2] + wz * cx - wx * cz)
        force[2] = mass * (lz + ax * centre[1] - ay * centre[0] + wx * cy - wy * cx)
        for i in range(3):
            arm.spin[k, i] = inertia[i, 0] * wx + inertia[i, 1] * wy + inertia[i, 2] * wz
            moment[i] = inertia[i, 0] * ax + inertia[i, 1] * ay + inertia[i, 2] * az
        sx, sy, sz = arm.spin[k, 0], arm.spin[k, 1], arm.spin[k, 2]
        moment[0] += wy * sz - wz * sy + centre[1] * force[2] - centre[2] * force[1]
        moment[1] += wz * sx - wx * sz + centre[2] * force[0] - centre[0] * force[2]
        moment[2] += wx * sy - wy * sx + centre[0] * force[1] - centre[1] * force[0]
    for k in range(limits.dof - 1, -1, -1):
        if k + 1 < limits.dof:
            turn, offset = arm.turns[k + 1], limits.offset[k + 1]
            force, moment = arm.forces[k + 1], arm.moments[k + 1]
            fx, fy, fz = along(turn, 0, force), along(turn, 1, force), along(turn, 2, force)
            arm.forces[k, 0] += fx
            arm.forces[k, 1] += fy
            arm.forces[k, 2] += fz
            arm.moments[k, 0] += along(turn, 0, moment) + offset[1] * fz - offset[2] * fy
            arm.moments[k, 1] += along(turn, 1, moment) + offset[2] * fx - offset[0] * fz
            arm.moments[k, 2] += along(turn, 2, moment) + offset[0] * fy - offset[1] * fx
        axis, moment = limits.axis[k], arm.moments[k]
        own = axis[0] * moment[0] + axis[1] * moment[1] + axis[2] * moment[2]
        arm.needs[k] = own + limits.rotor[k] * change[k]


@kernel()
def put_turn(turn: Array, placed: Array, axis: Array, angle: float) -> None:
    """Write the rotation from a link's frame to the one before: as the joint is placed, then about its axis."""
    s, c = sine_and_cosine(angle)
    x, y, z, v = axis[0], axis[1], axis[2], 1.0 - c
    for i in range(3):
        a, b, d = placed[i, 0], placed[i, 1], placed[i, 2]
        turn[i, 0] = a * (x * x * v + c) + b * (y * x * v + z * s) + d * (z * x * v - y * s)
        turn[i, 1] = a * (x * y * v - z * s) + b * (y * y * v + c) + d * (z * y * v + x * s)
        turn[i, 2] = a * (x * z * v + y * s) + b * (y * z * v - x * s) + d * (z * z * v + c)


@kernel()
def back(turn: Array, row: int, x: float, y: float, z: float) -> float:
    """Return a component of a vector in the turned frame."""
    return turn[0, row] * x + turn[1, row] * y + turn[2, row] * z


@kernel()
def along(turn: Array, row: int, vector: Array) -> float:
    """Return a component of a vector of the turned frame in the frame before."""
    return turn[row, 0] * vector[0] + turn[row, 1] * vector[1] + turn[row, 2] * vector[2]


@kernel()
def solve(square: Array, side: Array, size: int) -> None:
    """Solve square x = side in place, for a symmetric positive definite matrix."""
    decompose(square, size)
    for i in range(size):
        for k in range(i):
            side[i] -= square[i, k] * side[k]
        side[i] /= square[i, i]
    for i in range(size - 1, -1, -1):
        for k in range(i + 1, size):
            side[i] -= square[k, i] * side[k]
        side[i] /= square[i, i]


@kernel()
def decompose(square: Array, size: int) -> None:
    """Write Cholesky's root of a symmetric positive definite matrix to its lower triangle."""
    for i in range(size):
        for j in range(i + 1):
            total = square[i, j]
            for k in range(j):
                total -= square[i, k] * square[j, k]
            square[i, j] = math.sqrt(max(total, _TINY)) if i == j else total / square[j, j]
