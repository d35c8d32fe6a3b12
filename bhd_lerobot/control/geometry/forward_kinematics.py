"""From joint positions to frames.

Arrays inside are component-first, so that one posture and thousands run through the same operations, element by
element: a result does not depend on what it is computed together with.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import ArmChain, Placement
from bhd_lerobot.control.record import JOINTS
from bhd_lerobot.errors import ConfigError

Array = NDArray[np.float64]

_MOST_JOINTS = JOINTS - 1  # with the gripper
_TWISTS = ((0.0, -1.0), (1.0, 0.0), (1.0, 0.0), (0.0, -1.0), (0.0, 1.0), (1.0, 0.0))


@dataclass(frozen=True)
class UrGeometry:
    """The numbers of an arm of the UR geometry, whose joints 2, 3 and 4 are parallel: it has closed forms.

    They are those of the standard Denavit-Hartenberg convention [m]; all others are 0.
    """

    a2: float
    a3: float
    d1: float
    d4: float
    d5: float
    d6: float
    tool: tuple[float, float, float]

    @classmethod
    def of(cls, chain: ArmChain) -> "UrGeometry | None":
        """Return the numbers of a chain, or None if it has another structure."""
        if chain.dof != len(_TWISTS) or chain.base != Placement() or chain.tool != Placement(chain.tool.position):
            return None
        for link, (c, minus_s) in zip(chain.links, _TWISTS, strict=True):
            if link.rotation != ((1.0, 0.0, 0.0), (0.0, c, minus_s), (0.0, -minus_s, c)):
                return None
        a, across, d = zip(*(link.position for link in chain.links), strict=True)
        zeros = (*across, a[0], *a[3:], *d[1:3])
        if any(zeros) or not (a[1] and a[2] and d[3]):
            return None
        return cls(a[1], a[2], d[0], d[3], d[4], d[5], chain.tool.position)


class ForwardKinematics:
    """Frames, Jacobian and manipulability of an arm.

    Postures are joint positions [rad], shape (..., dof); every frame is given in the base frame.

    Raises:
        ConfigError: the chain has too many joints.
    """

    def __init__(self, chain: ArmChain) -> None:
        self.chain, self.dof = chain, chain.dof
        if chain.dof > _MOST_JOINTS:
            raise ConfigError(f"The arm has {chain.dof} joints; with its gripper it may have {_MOST_JOINTS}.")
        self.base, self.tool_in_flange = chain.base.matrix(), chain.tool.matrix()
        self._turns_tool = chain.tool.rotation != Placement().rotation
        self.links = np.stack([link.matrix() for link in chain.links])
        self.ur = ur = UrGeometry.of(chain)
        # What no posture changes: the base frame, the last rows; the heights of shoulder and upright axes.
        fixed = np.zeros((self.dof + 1, 4, 4))
        fixed[:, 3, 3] = 1.0
        fixed[0] = np.eye(4)
        if ur is not None:
            self._along_x, self._along_z = np.array((ur.a2, ur.a3)), np.array((ur.d4, ur.d5, ur.d6))
            fixed[1, 2, 1] = 1.0
            fixed[1, 2, 3] = ur.d1
        self._fixed = fixed

    def fill(self, row: Any) -> None:
        """Write the chain into a record of `GEOMETRY`."""
        row["dof"], row["base"][0], row["tool"] = self.dof, self.base[:3], self.tool_in_flange[:3]
        row["link"][: self.dof] = self.links[:, :3]

    def frames(self, q: Array) -> Array:
        """Return the base frame and the frame behind each joint, shape (..., dof + 1, 4, 4)."""
        return components_last(self.components(q), 3)

    def tool(self, q: Array) -> Array:
        """Return the tool frame, shape (..., 4, 4)."""
        flange = self.components(q)[self.dof]
        frame = flange.copy()
        frame[:3, 3] = _translated(flange, self.tool_in_flange[:3, 3])
        if self._turns_tool:
            for axis in range(3):
                frame[:3, axis] = _turned(flange, self.tool_in_flange[:3, axis])
        return components_last(frame, 2)

    def jacobian(self, q: Array) -> Array:
        """Return the geometric Jacobian at the tool centre point, shape (..., 6, dof).

        Rows are the linear velocity [m/rad] and the angular velocity [rad/rad] in the base frame.
        """
        frames = self.components(q)
        last = frames[self.dof]
        frames = frames[: self.dof].copy()
        frames[0, :3] = self.base[:3].reshape(3, 4, *(1,) * (frames.ndim - 3))
        axes, origins = frames[:, :3, 2], frames[:, :3, 3]
        arms = _translated(last, self.tool_in_flange[:3, 3]) - origins
        jacobian = np.empty((6, *frames.shape[:1], *frames.shape[3:]))
        for row, (i, j) in enumerate(((1, 2), (2, 0), (0, 1))):
            jacobian[row] = axes[:, i] * arms[:, j] - axes[:, j] * arms[:, i]
            jacobian[row + 3] = axes[:, row]
        return components_last(jacobian, 2)

    def tool_speed(self, q: Array, velocity: Array) -> Array:
        """Return how fast the tool moves [m/s], shape (n,), from positions and speeds of joints, shape (n, dof)."""
        # Sums over what lies otherwise in memory round otherwise: with it the number of arms would count.
        jacobian = np.ascontiguousarray(self.jacobian(q))[:, :3]
        return np.asarray(np.sqrt(((jacobian * velocity[:, None]).sum(axis=2) ** 2).sum(axis=1)))

    def manipulability(self, q: Array) -> Array:
        """Return the product of the Jacobian's singular values, of which there are six at the most, shape (...).

        Its unit is m^3 for six joints or more. With the UR geometry it is the product of the sines of elbow and second
        wrist joint, and the distance of the centre of the last wrist from the base's axis, measured in the arm's plane.
        """
        if self.ur is None:
            jacobian = self.jacobian(q)
            if self.dof == len(_TWISTS):
                return np.abs(np.linalg.det(jacobian))
            return np.asarray(np.linalg.svd(jacobian, compute_uv=False).prod(axis=-1))
        a2, a3 = self.ur.a2, self.ur.a3
        joints = components_first(np.asarray(q, np.float64), 1)
        q23 = joints[1] + joints[2]
        reach = a2 * np.cos(joints[1]) + a3 * np.cos(q23) + self.ur.d5 * np.sin(q23 + joints[3])
        return np.abs((a2 * a3) * np.sin(joints[2]) * np.sin(joints[4]) * reach)

    def components(self, q: Array) -> Array:
        """Return `frames` with the postures' axes last, shape (dof + 1, 4, 4, ...)."""
        angles = components_first(np.asarray(q, np.float64), 1)
        frames = np.empty((self.dof + 1, 4, 4, *angles.shape[1:]))
        frames[...] = self._fixed.reshape(self.dof + 1, 4, 4, *(1,) * (angles.ndim - 1))
        if self.ur is not None:
            return self._ur_components(angles.copy(), frames)
        c, s = np.cos(angles), np.sin(angles)
        single = (1,) * (angles.ndim - 1)
        before = self.base[:3].reshape(3, 4, *single)
        for k, link in enumerate(self.links.reshape(-1, 4, 4, *single)):
            x, y, z = before[:, 0], before[:, 1], before[:, 2]
            ahead, across, after = c[k] * x + s[k] * y, c[k] * y - s[k] * x, frames[k + 1, :3]
            np.multiply(ahead[:, None], link[0], out=after)
            after += across[:, None] * link[1]
            after += z[:, None] * link[2]
            after[:, 3] += before[:, 3]
            before = after
        return frames

    def _ur_components(self, angles: Array, frames: Array) -> Array:
        """Write the frames of the UR geometry, from angles that it overwrites."""
        angles[2] += angles[1]
        angles[3] += angles[2]  # the upright directions turn by the sum of the angles of the parallel joints
        c, s = np.cos(angles), np.sin(angles)
        rest = angles.shape[1:]
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


def _translated(frame: Array, offset: Array) -> Array:
    """Return the point at `offset` in a component-first frame of shape (4, 4, ...), shape (3, ...)."""
    return _turned(frame, offset) + frame[:3, 3]


def _turned(frame: Array, direction: Array) -> Array:
    """Return a direction that is given in a component-first frame, shape (3, ...)."""
    x, y, z = direction.tolist()
    return np.asarray(x * frame[:3, 0] + y * frame[:3, 1] + z * frame[:3, 2])
