"""How far an arm is from itself and from the table, with capsules for its links."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import ArmChain
from bhd_lerobot.control.geometry.forward_kinematics import ForwardKinematics
from bhd_lerobot.control.record import JOINTS
from bhd_lerobot.errors import ConfigError, unknown_name

Array = NDArray[np.float64]

_TINY = 1e-12  # [m^2]; keeps the divisions of capsules without length finite
# Postures in which an end of a capsule has another height if any joint lifts it, and by which it differs then [m].
_POSTURES = np.random.default_rng(0).uniform(-3.0, 3.0, (16, JOINTS))
_LIFTED = 1e-9


class CollisionModel:
    """Distances between the capsules of an arm, and between them and the table, which is z = 0 in the base frame.

    Negative distances are depths. An end of a capsule that no joint lifts is not held against the table.
    """

    def __init__(self, chain: ArmChain) -> None:
        self.chain = chain
        self._forward = ForwardKinematics(chain)
        capsules = {capsule.name: index for index, capsule in enumerate(chain.capsules)}
        for pair in chain.disjoint:
            for name in pair:
                if name not in capsules:
                    raise ConfigError(unknown_name("capsule", name, capsules))
        starts = np.array([capsule.start for capsule in chain.capsules]).reshape(-1, 3)
        ends = np.array([capsule.end for capsule in chain.capsules]).reshape(-1, 3)
        radii = np.array([capsule.radius for capsule in chain.capsules])
        pairs = np.array([(capsules[a], capsules[b]) for a, b in chain.disjoint], np.intp).reshape(-1, 2)
        # Segments in their frames: first the starts, which are points, then the ways to the ends, which are directions.
        self._count = len(capsules)
        self._frame = np.array([capsule.frame for capsule in chain.capsules] * 2, np.intp)
        self._segments = np.concatenate((starts, ends - starts)).T[:, :, None]
        self._first, self._second = pairs.T
        self._squares = np.maximum(np.sum((ends - starts) ** 2, axis=1), _TINY)
        squares = self._squares[:, None]
        self._square1, self._square2 = squares[self._first], squares[self._second]
        self._radii = (radii[self._first] + radii[self._second])[:, None]
        start, way = self._placed(_POSTURES[:, : chain.dof])
        below = [np.where(np.ptp(z, axis=-1) > _LIFTED, radii, -np.inf) for z in (start[2], start[2] + way[2])]
        self._below_start, self._below_end = np.array(below)[:, :, None]

    def fill(self, row: Any) -> None:
        """Write the chain, the capsules and their pairs into the record that a tick finds distances with."""
        self._forward.fill(row)
        count, pairs = self._count, len(self._first)
        for name, values in (
            ("frame", self._frame[:count]),
            ("start", self._segments[:, :count, 0].T),
            ("way", self._segments[:, count:, 0].T),
            ("long", self._squares),
            ("below_start", self._below_start[:, 0]),
            ("below_end", self._below_end[:, 0]),
        ):
            row[name][:count] = values
        for name, values in (("first", self._first), ("second", self._second), ("radii", self._radii[:, 0])):
            row[name][:pairs] = values

    def distances(self, q: Array) -> tuple[Array, Array]:
        """Return the smallest self distance and the smallest table distance of postures.

        Args:
            q: joint positions [rad], shape (..., dof).

        Returns:
            Distance of the closest checked pair of capsules and of the lowest capsule from the table [m], each of
            shape (...); infinite if there is nothing to check.
        """
        rest = np.shape(q)[:-1]
        pairs, heights = self._distances(q)
        return pairs.min(axis=0, initial=np.inf).reshape(rest), heights.min(axis=0, initial=np.inf).reshape(rest)

    def slopes(self) -> tuple[Array, Array]:
        """Return how much a distance can change at the most when a joint turns [m/rad].

        Returns:
            For each checked pair, shape (pairs, dof), and for each capsule's distance from the table, shape (capsules,
            dof). A pair's distance depends on the joints between its capsules only.
        """
        chain, joints = self.chain, np.arange(self._forward.dof)
        lengths = np.array([math.hypot(*link.position) for link in chain.links])
        heights = np.zeros((self._count, len(joints)))
        for row, capsule in zip(heights, chain.capsules, strict=True):
            end = max(math.hypot(*capsule.start), math.hypot(*capsule.end))
            for joint in joints[: capsule.frame]:
                row[joint] = lengths[joint : capsule.frame].sum() + end
        frames = [capsule.frame for capsule in chain.capsules]
        pairs = np.zeros((len(self._first), len(joints)))
        for row, one, other in zip(pairs, self._first, self._second, strict=True):
            near, far = sorted((one, other), key=lambda index: frames[index])
            row[frames[near] :] = heights[far, frames[near] :]
        return pairs, heights

    def each(self, q: Array) -> Array:
        """Return every distance that `distances` takes the smallest of, shape (pairs + capsules, n): first the pairs.

        Args:
            q: joint positions [rad], shape (n, dof).
        """
        return np.concatenate(self._distances(q))

    def closest_pair(self, q: Array) -> tuple[str, str]:
        """Return the names of the two capsules that come closest in a posture of shape (dof,)."""
        return self.chain.disjoint[int(self._distances(q)[0].argmin())]

    def lowest(self, q: Array) -> str:
        """Return the name of the capsule that is closest to the table in a posture of shape (dof,)."""
        return self.chain.capsules[int(self._distances(q)[1].argmin())].name

    def _distances(self, q: Array) -> tuple[Array, Array]:
        """Return the distances of pairs, and of capsules from the table, shapes (pairs, n) and (capsules, n)."""
        start, way = self._placed(np.reshape(q, (-1, self._forward.dof)))
        heights = np.minimum(start[2] - self._below_start, start[2] + way[2] - self._below_end)
        way1, way2 = way[:, self._first], way[:, self._second]
        apart = start[:, self._first] - start[:, self._second]
        return _segment_distance(apart, way1, way2, self._square1, self._square2) - self._radii, heights

    def _placed(self, q: Array) -> tuple[Array, Array]:
        """Return the start of each capsule and the way to its end, shapes (3, capsules, n)."""
        frames = self._forward.components(q).transpose(1, 2, 0, 3)
        frames = frames[:3, :, self._frame]  # shape (3, 4, 2 capsules, n)
        segments = frames[:, 0] * self._segments[0]
        segments += frames[:, 1] * self._segments[1]
        segments += frames[:, 2] * self._segments[2]
        start, way = segments[:, : self._count], segments[:, self._count :]
        start += frames[:, 3, : self._count]
        return start, way


def _segment_distance(apart: Array, way1: Array, way2: Array, square1: Array, square2: Array) -> Array:
    """Return the distance between segments.

    The first guess, the closest points of the two lines, is poor for segments that are nearly parallel; it need not be
    good, because each segment then gives its closest point to the other's, and for parallel segments any guess will do.

    Args:
        apart: from the second's start to the first's [m], shape (3, pairs, n).
        way1: from the first's start to its end [m], shape (3, pairs, n).
        way2: from the second's start to its end [m], shape (3, pairs, n).
        square1: squared length of the first [m^2], positive, shape (pairs, 1).
        square2: squared length of the second [m^2], positive, shape (pairs, 1).

    Returns:
        Shape (pairs, n) [m].
    """
    across, off1, off2 = _dot(way1, way2), _dot(way1, apart), _dot(way2, apart)
    room = np.maximum(square1 * square2 - across * across, _TINY * square1 * square2)
    share1 = _clipped((across * off2 - off1 * square2) / room)
    share2 = _clipped((across * share1 + off2) / square2)
    share1 = _clipped((across * share2 - off1) / square1)
    gap = apart + share1 * way1 - share2 * way2
    return np.sqrt(_dot(gap, gap))


def _dot(a: Array, b: Array) -> Array:
    product = a * b
    total: Array = product[0] + product[1]
    total += product[2]
    return total


def _clipped(share: Array) -> Array:
    np.maximum(share, 0.0, out=share)
    return np.minimum(share, 1.0, out=share)
