"""Rotations as matrices, quaternions and vectors."""

import numpy as np
import pinocchio
from numpy.typing import NDArray

Array = NDArray[np.float64]


def rotation_vectors(rotations: Array) -> Array:
    """Return axis times angle [rad], shape (n, 3), of rotation matrices, shape (n, 3, 3)."""
    vectors = np.empty((len(rotations), 3))
    for row, rotation in enumerate(rotations):
        vectors[row] = pinocchio.log3(rotation)
    return vectors


def turned(rotations: Array, vectors: Array) -> Array:
    """Return rotation matrices, shape (n, 3, 3), turned about axes of the base frame by axis times angle [rad].

    They are orthonormal: rounding does not add up when this is done again and again.
    """
    results = np.empty_like(rotations)
    for row, vector in enumerate(vectors):
        results[row] = pinocchio.Quaternion(pinocchio.exp3(vector) @ rotations[row]).normalized().matrix()
    return results


def rotation_matrices(quaternions: Array) -> Array:
    """Return rotation matrices, shape (n, 3, 3), of quaternions w, x, y, z of any length but 0, shape (n, 4)."""
    results = np.empty((len(quaternions), 3, 3))
    for row, quaternion in enumerate(quaternions):
        results[row] = pinocchio.Quaternion(*quaternion.tolist()).normalized().matrix()
    return results
