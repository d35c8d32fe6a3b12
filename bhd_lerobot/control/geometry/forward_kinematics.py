"""From joint positions to frames, for arms of the UR geometry, whose joints 2, 3 and 4 are parallel.

Arrays inside are component-first, so that one posture and thousands run through the same operations, element by
element: a result does not depend on what it is computed together with.
"""

import math

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import ArmChain
from bhd_lerobot.errors import ConfigError

Array = NDArray[np.float64]

DOF = 6
_TWISTS = (math.pi / 2, 0.0, 0.0, math.pi / 2, -math.pi / 2, 0.0)


class ForwardKinematics:
    """Frames, Jacobian and manipulability of an arm.

    Postures are joint positions [rad], shape (..., 6); every frame is given in the base frame.

    Raises:
        ConfigError: the chain has another structure than the closed forms.
    """

    def __init__(self, chain: ArmChain) -> None:
        _check(chain)
        self.chain = chain
        self.dof = DOF
        self._along_x = np.array(chain.a[1:3])
        self._along_z = np.array(chain.d[3:6])
        # What no posture changes: the base frame, the heights of shoulder and upright axes, the last rows.
        fixed = np.zeros((DOF + 1, 4, 4))
        fixed[:, 3, 3] = 1.0
        fixed[0] = np.eye(4)
        fixed[1, 2, 1] = 1.0
        fixed[1, 2, 3] = chain.d[0]
        self._fixed = fixed

    def frames(self, q: Array) -> Array:
        """Return the base frame and the frame behind each joint, shape (..., 7, 4, 4)."""
        return components_last(self.components(q), 3)

    def tool(self, q: Array) -> Array:
        """Return the tool frame, shape (..., 4, 4)."""
        frame = self.components(q)[DOF].copy()
        frame[:3, 3] = _translated(frame, self.chain.tool)
        return components_last(frame, 2)

    def jacobian(self, q: Array) -> Array:
        """Return the geometric Jacobian at the tool centre point, shape (..., 6, 6).

        Rows are the linear velocity [m/rad] and the angular velocity [rad/rad] in the base frame.
        """
        frames = self.components(q)
        axes, origins = frames[:DOF, :3, 2], frames[:DOF, :3, 3]
        arms = _translated(frames[DOF], self.chain.tool) - origins
        jacobian = np.empty((6, DOF, *frames.shape[3:]))
        for row, (i, j) in enumerate(((1, 2), (2, 0), (0, 1))):
            jacobian[row] = axes[:, i] * arms[:, j] - axes[:, j] * arms[:, i]
            jacobian[row + 3] = axes[:, row]
        return components_last(jacobian, 2)

    def tool_speed(self, q: Array, velocity: Array) -> Array:
        """Return how fast the tool moves [m/s], shape (n,), from positions and speeds of joints, shape (n, 6)."""
        # Sums over what lies otherwise in memory round otherwise: with it the number of arms would count.
        jacobian = np.ascontiguousarray(self.jacobian(q))[:, :3]
        return np.asarray(np.sqrt(((jacobian * velocity[:, None]).sum(axis=2) ** 2).sum(axis=1)))

    def manipulability(self, q: Array) -> Array:
        """Return the product of the Jacobian's singular values [m^3], shape (...).

        It is the product of the sines of elbow and second wrist joint, and the distance of the centre of the last
        wrist from the base's axis, measured in the arm's plane.
        """
        a2, a3 = self.chain.a[1:3]
        joints = components_first(np.asarray(q, np.float64), 1)
        q23 = joints[1] + joints[2]
        reach = a2 * np.cos(joints[1]) + a3 * np.cos(q23) + self.chain.d[4] * np.sin(q23 + joints[3])
        return np.abs((a2 * a3) * np.sin(joints[2]) * np.sin(joints[4]) * reach)

    def components(self, q: Array) -> Array:
        """Return `frames` with the postures' axes last, shape (7, 4, 4, ...)."""
        angles = components_first(np.asarray(q, np.float64), 1).copy()
        angles[2] += angles[1]
        angles[3] += angles[2]  # the upright directions turn by the sum of the angles of the parallel joints
        c, s = np.cos(angles), np.sin(angles)
        rest = angles.shape[1:]
        frames = np.empty((DOF + 1, 4, 4, *rest))
        frames[...] = self._fixed.reshape(DOF + 1, 4, 4, *(1,) * len(rest))
        ahead = frames[1, :2, 0]  # horizontal direction of the arm's plane
        ahead[0], ahead[1] = c[0], s[0]
        frames[1:4, 0, 2] = s[0]  # the parallel axes
        frames[1:4, 1, 2] = -c[0]
        frames[4, :3, 1] = frames[1, :3, 2]
        np.multiply(c[1:4, None], ahead, out=frames[2:5, :2, 0])
        frames[2:5, 2, 0] = s[1:4]
        np.multiply(-s[1:3, None], ahead, out=frames[2:4, :2, 1])
        frames[2:4, 2, 1] = c[1:3]
        np.multiply(s[3], ahead, out=frames[4, :2, 2])
        frames[4, 2, 2] = -c[3]
        xy = frames[4, :3, :2]
        along, across = c[4] * xy, s[4] * xy
        np.add(along[:, 0], across[:, 1], out=frames[5, :3, 0])
        np.negative(frames[4, :3, 2], out=frames[5, :3, 1])
        np.subtract(along[:, 1], across[:, 0], out=frames[5, :3, 2])
        xy = frames[5, :3, :2]
        along, across = c[5] * xy, s[5] * xy
        np.add(along[:, 0], across[:, 1], out=frames[6, :3, 0])
        np.subtract(along[:, 1], across[:, 0], out=frames[6, :3, 1])
        frames[6, :3, 2] = frames[5, :3, 2]
        steps = (-1, 1, *(1,) * len(rest))
        np.multiply(self._along_x.reshape(steps), frames[2:4, :3, 0], out=frames[2:4, :3, 3])
        np.multiply(self._along_z.reshape(steps), frames[3:6, :3, 2], out=frames[4:7, :3, 3])
        origins = frames[1:, :3, 3]
        np.add.accumulate(origins, axis=0, out=origins)
        return frames


def components_first(array: Array, count: int) -> Array:
    """Return a view with the last `count` axes first. What `np.moveaxis` does, in a fifth of the time."""
    split = array.ndim - count
    return array.transpose(*range(split, array.ndim), *range(split))


def components_last(array: Array, count: int) -> Array:
    """Return a view with the first `count` axes last."""
    return array.transpose(*range(count, array.ndim), *range(count))


def _translated(frame: Array, offset: tuple[float, float, float]) -> Array:
    """Return the point at `offset` in a component-first frame of shape (4, 4, ...), shape (3, ...)."""
    x, y, z = offset
    return x * frame[:3, 0] + y * frame[:3, 1] + z * frame[:3, 2] + frame[:3, 3]


def _check(chain: ArmChain) -> None:
    """Raise unless the chain has the UR geometry."""
    lengths = (chain.joints, chain.a, chain.d, chain.alpha)
    if any(len(values) != DOF for values in lengths):
        raise ConfigError(f"The chain has {[len(v) for v in lengths]} joints, a, d and alpha; each needs {DOF}.")
    if not all(math.isfinite(value) for value in (*chain.a, *chain.d, *chain.alpha, *chain.tool)):
        raise ConfigError(
            f"a = {chain.a}, d = {chain.d}, alpha = {chain.alpha}, tool = {chain.tool}: all must be finite."
        )
    if any(chain.a[i] for i in (0, 3, 4, 5)) or not (chain.a[1] and chain.a[2]):
        raise ConfigError(f"a is {chain.a}; the closed form needs 0 everywhere but at the second and third joint.")
    if any(chain.d[i] for i in (1, 2)) or not chain.d[3]:
        raise ConfigError(f"d is {chain.d}; the closed form needs 0 at the second and third joint, not at the fourth.")
    if max(abs(twist - wanted) for twist, wanted in zip(chain.alpha, _TWISTS, strict=True)) > 1e-12:
        raise ConfigError(f"alpha is {chain.alpha}; the closed form needs {_TWISTS}.")
