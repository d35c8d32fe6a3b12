"""Rotations as matrices, quaternions and vectors."""

import numpy as np
import pinocchio
from numpy.typing import NDArray

Array = NDArray[np.float64]


def rotation_vectors(rotations: Array) -> Array:
    """Return axis times angle [rad], shape (n, 3), of rotation matrices, shape (n, 3, 3)."""
    return np.array([pinocchio.log3(rotation) for rotation in rotations]).reshape(-1, 3)


def turned(rotations: Array, vectors: Array) -> Array:
    """Return rotation matrices, shape (n, 3, 3), turned about axes of the base frame by axis times angle [rad].

    They are orthonormal: rounding does not add up when this is done again and again.
    """
    results = [
        pinocchio.Quaternion(pinocchio.exp3(vector) @ rotation).normalized().matrix()
        for rotation, vector in zip(rotations, vectors, strict=True)
    ]
    return np.array(results).reshape(-1, 3, 3)


def rotation_matrices(quaternions: Array) -> Array:
    """Return rotation matrices, shape (n, 3, 3), of quaternions w, x, y, z of any length but 0, shape (n, 4)."""
    results = [pinocchio.Quaternion(*quaternion.tolist()).normalized().matrix() for quaternion in quaternions]
    return np.array(results).reshape(-1, 3, 3)
