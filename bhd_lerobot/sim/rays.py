"""Where the rays of a moving sensor start and point."""

import numpy as np
from numpy.typing import NDArray


def rays_in_world(
    poses: NDArray[np.float64], offset: NDArray[np.float64], directions: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the origins and directions of rays in the world frame, each of shape (k, rays, 3) or to be spread to it.

    Args:
        poses: position [m] and unit quaternion w, x, y, z of the body that carries the sensor, shape (k, 7 or more).
        offset: where the rays start in that body's frame [m], shape (3,).
        directions: unit vectors in that body's frame, shape (rays, 3).
    """
    rotation = _rotation_matrices(poses[:, 3:7])
    # Sums written out: a matrix product may round differently for different numbers of simulations.
    origin = poses[:, None, 0:3] + (
        rotation[:, None, :, 0] * offset[0] + rotation[:, None, :, 1] * offset[1] + rotation[:, None, :, 2] * offset[2]
    )
    heading = (
        rotation[:, None, :, 0] * directions[None, :, 0:1]
        + rotation[:, None, :, 1] * directions[None, :, 1:2]
        + rotation[:, None, :, 2] * directions[None, :, 2:3]
    )
    return origin, heading


def _rotation_matrices(quaternions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rotation matrices of unit quaternions wxyz: shape (k, 4) gives (k, 3, 3)."""
    w, x, y, z = quaternions.T
    matrix = np.empty((len(quaternions), 3, 3))
    matrix[:, 0, 0] = 1 - 2 * (y * y + z * z)
    matrix[:, 0, 1] = 2 * (x * y - w * z)
    matrix[:, 0, 2] = 2 * (x * z + w * y)
    matrix[:, 1, 0] = 2 * (x * y + w * z)
    matrix[:, 1, 1] = 1 - 2 * (x * x + z * z)
    matrix[:, 1, 2] = 2 * (y * z - w * x)
    matrix[:, 2, 0] = 2 * (x * z - w * y)
    matrix[:, 2, 1] = 2 * (y * z + w * x)
    matrix[:, 2, 2] = 1 - 2 * (x * x + y * y)
    return matrix
