"""Orientations as unit quaternions w, x, y, z, as a tick turns them."""

import math

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.control.kernels import kernel

Array = NDArray[np.float64]

_TINY = 1e-12


@kernel()
def turn_by(turn: Array, vector: Array, share: float) -> None:
    """Turn an orientation about an axis of the base frame, by a share of axis times angle [rad], shape (3,).

    It stays of unit length: rounding does not add up when this is done again and again.
    """
    angle = share * math.sqrt(vector[0] * vector[0] + vector[1] * vector[1] + vector[2] * vector[2])
    c = math.cos(0.5 * angle)
    s = share * (math.sin(0.5 * angle) / angle if abs(angle) > _TINY else 0.5)
    x, y, z = s * vector[0], s * vector[1], s * vector[2]
    q0, q1, q2, q3 = turn[0], turn[1], turn[2], turn[3]
    turn[0] = c * q0 - x * q1 - y * q2 - z * q3
    turn[1] = c * q1 + x * q0 + y * q3 - z * q2
    turn[2] = c * q2 - x * q3 + y * q0 + z * q1
    turn[3] = c * q3 + x * q2 - y * q1 + z * q0
    normalise(turn)


@kernel()
def find_way(way: Array, to: Array, start: Array) -> None:
    """Write the shortest rotation from one orientation to another, as axis times angle [rad] in the base frame."""
    w = to[0] * start[0] + to[1] * start[1] + to[2] * start[2] + to[3] * start[3]
    way[0] = start[0] * to[1] - to[0] * start[1] - to[2] * start[3] + to[3] * start[2]
    way[1] = start[0] * to[2] - to[0] * start[2] - to[3] * start[1] + to[1] * start[3]
    way[2] = start[0] * to[3] - to[0] * start[3] - to[1] * start[2] + to[2] * start[1]
    size = math.sqrt(way[0] * way[0] + way[1] * way[1] + way[2] * way[2])
    factor = 2.0 * math.atan2(size, abs(w)) / size if size > _TINY else 2.0
    if w < 0.0:
        factor = -factor
    for i in range(3):
        way[i] *= factor


@kernel()
def put_quaternion(turn: Array, rotation: Array) -> None:
    """Write the quaternion of a rotation matrix: of four formulas the one with the largest square root is precise."""
    xx, yy, zz = rotation[0, 0], rotation[1, 1], rotation[2, 2]
    x, y, z = rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]
    xy, xz, yz = rotation[0, 1] + rotation[1, 0], rotation[0, 2] + rotation[2, 0], rotation[1, 2] + rotation[2, 1]
    if xx + yy + zz >= max(xx, yy, zz):
        turn[0], turn[1], turn[2], turn[3] = 1.0 + xx + yy + zz, x, y, z
    elif xx >= yy and xx >= zz:
        turn[0], turn[1], turn[2], turn[3] = x, 1.0 + xx - yy - zz, xy, xz
    elif yy >= zz:
        turn[0], turn[1], turn[2], turn[3] = y, xy, 1.0 - xx + yy - zz, yz
    else:
        turn[0], turn[1], turn[2], turn[3] = z, xz, yz, 1.0 - xx - yy + zz
    normalise(turn)


@kernel()
def normalise(turn: Array) -> None:
    """Bring a quaternion to unit length."""
    size = math.sqrt(turn[0] * turn[0] + turn[1] * turn[1] + turn[2] * turn[2] + turn[3] * turn[3])
    for i in range(4):
        turn[i] /= size
