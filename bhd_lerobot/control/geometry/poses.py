"""Poses as numbers: homogeneous transforms to position and quaternion."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

# A quaternion and its negative are one orientation. Of the two, the one on the side of this is written: the tool that
# points down. It is the orientation farthest from where the sign flips, so that a recording near it has no jumps.
_DOWN = np.array([0.0, 1.0, 0.0, 0.0])
_PARTS = ("qw", "qx", "qy", "qz")


def pose_vectors(matrices: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return positions and quaternions wxyz, shape (..., 7), of homogeneous transforms, shape (..., 4, 4)."""
    r = matrices[..., :3, :3]
    # Of four formulas the one with the largest square root is precise.
    xx, yy, zz = r[..., 0, 0], r[..., 1, 1], r[..., 2, 2]
    squares = np.stack([1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz], axis=-1)
    best = squares.argmax(axis=-1)
    a, b, c = r[..., 2, 1] - r[..., 1, 2], r[..., 0, 2] - r[..., 2, 0], r[..., 1, 0] - r[..., 0, 1]
    d, e, f = r[..., 0, 1] + r[..., 1, 0], r[..., 0, 2] + r[..., 2, 0], r[..., 1, 2] + r[..., 2, 1]
    rows = np.stack(
        [
            np.stack([squares[..., 0], a, b, c], axis=-1),
            np.stack([a, squares[..., 1], d, e], axis=-1),
            np.stack([b, d, squares[..., 2], f], axis=-1),
            np.stack([c, e, f, squares[..., 3]], axis=-1),
        ],
        axis=-2,
    )
    quaternion = np.take_along_axis(rows, best[..., None, None], axis=-2)[..., 0, :]
    quaternion = quaternion / np.sqrt((quaternion * quaternion).sum(axis=-1, keepdims=True))
    side = (quaternion * _DOWN).sum(axis=-1, keepdims=True)
    first = np.take_along_axis(quaternion, (quaternion != 0).argmax(axis=-1)[..., None], axis=-1)
    sign = np.where(side != 0, np.sign(side), np.sign(first))
    return np.concatenate([matrices[..., :3, 3], quaternion * sign], axis=-1)


def quaternion_columns(names: Sequence[str]) -> list[int]:
    """Return the columns at which quaternions begin: `…_qw`, `…_qx`, `…_qy`, `…_qz`, by option with `.pos` after it."""
    plain = [name.removesuffix(".pos") for name in names]
    found = []
    for column, name in enumerate(plain[:-3]):
        stem = name.removesuffix(_PARTS[0])
        if stem != name and plain[column : column + 4] == [stem + part for part in _PARTS]:
            found.append(column)
    return found
