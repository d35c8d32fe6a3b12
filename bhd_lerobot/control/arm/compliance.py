"""How a tool gives way to forces: stiffness and damping, checked, and the damping that lets nothing ring."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bhd_lerobot.control.geometry.chain import decompose
from bhd_lerobot.control.kernels import kernel
from bhd_lerobot.errors import ConfigError

Array = NDArray[np.float64]

# Estimates for a 500 Hz torque loop on an arm of this size; natural frequencies stay below 10 Hz, far
# from the 80 Hz at which a damped loop with one tick of delay starts to ring.
MAX_STIFFNESS = 5000.0  # [N/m]
MAX_TURN_STIFFNESS = 300.0  # [N m/rad]
MIN_RATIO = 0.5  # a tool that is damped less swings back and forth against what it touches
MAX_FORCE = 120.0  # [N] below what ISO/TS 15066 permits on a hand that is clamped, 140 N
MAX_MOMENT = 20.0  # [N m] below what the wrists have
# [rad/s] Where there is no spring there is no natural frequency to damp: damping is that of a spring of this one.
_LEAST_FREQUENCY = 2.0
_SWEEPS, _PRECISE = 12, 1e-24  # of Jacobi's rotations; share of the squares off the diagonal that remains


@dataclass(frozen=True, eq=False)
class Compliance:
    """The spring and the damper between a tool and its equilibrium, in the base frame; linear first, then angular.

    Attributes:
        stiffness: [N/m, N m/rad], shape (6, 6), symmetric without negative eigenvalues; or its diagonal, shape (6,).
        damping_ratio: 1 for critical damping of the inertia that the tool has in its posture; 0.5 to 2.
        damping: a damping matrix to use in place of the ratio [N s/m, N m s/rad], shape (6, 6) or (6,); None for none.
        max_force: largest force of spring and feed-forward together [N], at most 120.
        max_moment: largest moment of both together [N m], at most 20.

    Raises:
        ConfigError: a value is out of its range, or a matrix is not symmetric or has negative eigenvalues.
    """

    stiffness: ArrayLike = (500.0, 500.0, 500.0, 40.0, 40.0, 40.0)
    damping_ratio: float = 1.0
    damping: ArrayLike | None = None
    max_force: float = 80.0
    max_moment: float = 15.0

    def __post_init__(self) -> None:
        stiffness = _matrix("stiffness", self.stiffness)
        for block, largest, unit in ((slice(3), MAX_STIFFNESS, "N/m"), (slice(3, 6), MAX_TURN_STIFFNESS, "N m/rad")):
            value = float(np.linalg.eigvalsh(stiffness[block, block])[-1])
            if value > largest * (1 + 1e-9):
                raise ConfigError(f"The stiffness is {value:.6g} {unit}; at most {largest:.6g} {unit} is allowed.")
        if not MIN_RATIO <= self.damping_ratio <= 2.0:
            raise ConfigError(f"damping_ratio is {self.damping_ratio}; it must be between {MIN_RATIO:g} and 2.")
        for name, most, unit in (("max_force", MAX_FORCE, "N"), ("max_moment", MAX_MOMENT, "N m")):
            if not 0.0 < getattr(self, name) <= most:
                raise ConfigError(f"{name} is {getattr(self, name)}; it must be above 0 and at most {most:g} {unit}.")
        object.__setattr__(self, "stiffness", stiffness)
        if self.damping is not None:
            object.__setattr__(self, "damping", _matrix("damping", self.damping))


@kernel()
def find_damping(spring: Any) -> None:
    """Write to a spring's `damping` the matrix with which every mode of mass and spring has its damping ratio.

    Mass and stiffness are brought to diagonal form together; with 1 = Q^T mass Q and w^2 = Q^T stiffness Q the damping
    is that of 2 ratio w. It is symmetric and positive definite. The inverse of the mass matrix, `mobility`, is positive
    definite; `root`, `square` and `modes` are lost.
    """
    root, square, modes = spring.root, spring.square, spring.modes
    for i in range(6):
        for j in range(6):
            root[i, j] = spring.mobility[i, j] if j <= i else 0.0
    decompose(root, 6)
    multiply(modes, spring.stiffness, root, False)
    multiply(square, root, modes, True)
    find_modes(square, modes)
    for mode in range(6):  # what takes modes to forces: root^-T modes
        for i in range(5, -1, -1):
            for k in range(i + 1, 6):
                modes[i, mode] -= root[k, i] * modes[k, mode]
            modes[i, mode] /= root[i, i]
        square[mode, 0] = 2.0 * spring.ratio * math.sqrt(max(square[mode, mode], _LEAST_FREQUENCY * _LEAST_FREQUENCY))
    for i in range(6):
        for j in range(6):
            spring.damping[i, j] = 0.0
            for mode in range(6):
                spring.damping[i, j] += square[mode, 0] * modes[i, mode] * modes[j, mode]


@kernel()
def multiply(product: Array, one: Array, other: Array, is_transposed: bool) -> None:
    """Write the product of two matrices of shape (6, 6), of the first one transposed if that is wanted."""
    for i in range(6):
        for j in range(6):
            product[i, j] = 0.0
            for k in range(6):
                product[i, j] += (one[k, i] if is_transposed else one[i, k]) * other[k, j]


@kernel()
def find_modes(square: Array, modes: Array) -> None:
    """Bring a symmetric matrix of shape (6, 6) to diagonal form in place, and write its eigenvectors as columns.

    By Jacobi's rotations, each of which brings one element to zero.
    """
    for i in range(6):
        for j in range(6):
            modes[i, j] = 1.0 if i == j else 0.0
    for _ in range(_SWEEPS):
        off = whole = 0.0
        for i in range(6):
            whole += square[i, i] * square[i, i]
            for j in range(i):
                off += square[i, j] * square[i, j]
        if not off > _PRECISE * whole:
            return
        for p in range(5):
            for q in range(p + 1, 6):
                if square[p, q] != 0.0:
                    rotate(square, modes, p, q)


@kernel()
def rotate(square: Array, modes: Array, p: int, q: int) -> None:
    """Bring an element of a symmetric matrix to zero by a rotation of two axes."""
    ratio = (square[q, q] - square[p, p]) / (2.0 * square[p, q])
    tangent = math.copysign(1.0, ratio) / (abs(ratio) + math.sqrt(ratio * ratio + 1.0))
    c = 1.0 / math.sqrt(tangent * tangent + 1.0)
    s = tangent * c
    for k in range(6):
        one, other = square[k, p], square[k, q]
        square[k, p], square[k, q] = c * one - s * other, s * one + c * other
    for k in range(6):
        one, other = square[p, k], square[q, k]
        square[p, k], square[q, k] = c * one - s * other, s * one + c * other
        one, other = modes[k, p], modes[k, q]
        modes[k, p], modes[k, q] = c * one - s * other, s * one + c * other
    square[p, q] = square[q, p] = 0.0


def _matrix(name: str, values: ArrayLike) -> Array:
    """Return a checked, read-only matrix of shape (6, 6)."""
    array = np.array(values, np.float64)
    matrix = np.diag(array) if array.shape == (6,) else array
    if matrix.shape != (6, 6) or not np.isfinite(matrix).all():
        raise ConfigError(f"The {name} is {array.tolist()}; it must be 6 finite numbers, or 6 x 6.")
    if not np.allclose(matrix, matrix.T, rtol=0.0, atol=1e-9 * max(1.0, np.abs(matrix).max())):
        raise ConfigError(f"The {name} is {array.tolist()}; it must be symmetric, or the tool gains energy in circles.")
    least = float(np.linalg.eigvalsh(matrix)[0])
    if least < -1e-9 * max(1.0, np.abs(matrix).max()):
        raise ConfigError(f"The {name} has the eigenvalue {least:.6g}; none may be negative.")
    matrix = 0.5 * (matrix + matrix.T)
    matrix.setflags(write=False)
    return matrix
