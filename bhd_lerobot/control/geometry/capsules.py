"""Capsules for the collision checks of an arm whose shapes are known: how they enclose shapes, and which may meet."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from bhd_lerobot.bodies.body import ArmChain
from bhd_lerobot.control.geometry.collision import CollisionModel

Array = NDArray[np.float64]

_RADII = np.linspace(1.0, 2.0, 41)  # of the radius that the sides need; with a larger one a capsule may be shorter
_ROUNDS, _QUICK = 200, 40  # towards the middle of a disc
_FEW = 8  # points of a shape that is not cut: a box
_CUTS = np.linspace(0.2, 0.8, 7)  # where along it
_SMALLER = 0.9  # of the volume: two capsules in place of one
_COVER = 1.0 + 1e-9
_POSTURES, _BATCH = 2000, 100
_AROUND, _DRAWS = np.geomspace(0.4, 0.005, 15), 8  # of the ranges: so far, and so often, around the nearest of these
_NEVER = 0.02  # [m] capsules that stay so far apart in all of these postures do not meet
_ALWAYS = 0.95  # share of the postures; capsules that are too near in more say nothing about a posture


@dataclass(frozen=True)
class Balls:
    """A shape that balls span: their convex hull. A vertex is a ball without a radius.

    Attributes:
        centres: shape (n, 3) [m].
        radii: shape (n,) [m].
    """

    centres: Array
    radii: Array

    def __add__(self, other: "Balls") -> "Balls":
        return Balls(np.concatenate((self.centres, other.centres)), np.concatenate((self.radii, other.radii)))

    def moved(self, pose: Array) -> "Balls":
        """Return the shape in the frame that its own frame, of shape (4, 4), is given in."""
        return Balls(self.centres @ pose[:3, :3].T + pose[:3, 3], self.radii)


def enclosing(shape: Balls, rounds: int = _ROUNDS) -> tuple[Array, Array, float]:
    """Return the ends and the radius of a small capsule around a shape, along one of its principal axes [m]."""
    centres, radii = shape.centres, shape.radii
    if len(centres) <= 2 and np.ptp(radii) == 0.0:  # a ball or a capsule
        return centres[0], centres[-1], float(radii[0])
    middle = centres.mean(axis=0)
    _, axes = np.linalg.eigh((centres - middle).T @ (centres - middle))
    found = [_along(axis, middle, centres, radii, rounds) for axis in axes.T]
    return min(found, key=lambda capsule: _volume(*capsule))


def halves(shape: Balls) -> list[Balls]:
    """Return two parts of a shape if the capsules around them are much smaller than the one around it, or the shape.

    Only the hull of points is cut, squarely to its longest axis.
    """
    points = shape.centres
    if shape.radii.any() or len(points) <= _FEW:
        return [shape]
    try:
        triangles = ConvexHull(points).simplices
    except QhullError:  # it is flat
        return [shape]
    one, other = points[triangles], points[np.roll(triangles, 1, axis=1)]  # the ends of its edges
    one, other = one.reshape(-1, 3), other.reshape(-1, 3)
    middle = points.mean(axis=0)
    _, axes = np.linalg.eigh((points - middle).T @ (points - middle))
    axis = axes[:, -1]
    along, first, last = (which @ axis for which in (points, one, other))
    best, least = [shape], _SMALLER * _volume(*enclosing(shape, _QUICK))
    for share in _CUTS:
        cut = along.min() + share * np.ptp(along)
        crosses = (first < cut) & (last >= cut)
        at = ((cut - first[crosses]) / (last[crosses] - first[crosses]))[:, None]
        edge = one[crosses] + at * (other[crosses] - one[crosses])
        parts = [np.concatenate((points[side], edge)) for side in (along < cut, along >= cut)]
        both = [Balls(part, np.zeros(len(part))) for part in parts]
        size = sum(_volume(*enclosing(part, _QUICK)) for part in both)
        if size < least:
            best, least = both, size
    return best


def _along(axis: Array, middle: Array, centres: Array, radii: Array, rounds: int) -> tuple[Array, Array, float]:
    """Return the smallest capsule in a direction."""
    along = (centres - middle) @ axis
    across = centres - middle - along[:, None] * axis
    centre = across.mean(axis=0)
    best, least = centre, np.inf
    for number in range(rounds):  # towards what is farthest, by less and less (Bădoiu and Clarkson)
        far = np.linalg.norm(across - centre, axis=1) + radii
        if far.max() < least:
            best, least = centre, float(far.max())
        centre = centre + (across[far.argmax()] - centre) / (number + 2)
    aside = np.linalg.norm(across - best, axis=1)
    capsules = []
    for radius in least * _COVER * _RADII:
        room = np.sqrt(np.maximum((radius - radii) ** 2 - aside**2, 0.0))
        first, last = (along + room).min(), (along - room).max()
        if first > last:
            first = last = (first + last) / 2
        capsules.append((middle + best + first * axis, middle + best + last * axis, float(radius)))
    return min(capsules, key=lambda capsule: _volume(*capsule))


def _volume(start: Array, end: Array, radius: float) -> float:
    return float(np.pi * radius**2 * (np.linalg.norm(end - start) + 4 / 3 * radius))


def with_pairs(chain: ArmChain, home: Array, lower: Array, upper: Array) -> ArmChain:
    """Return a chain with the pairs of capsules that may meet.

    Pairs are left out that are on one link or on adjacent ones, that are too near at home, and those that are never
    near, or nearly always too near, in 2,000 random postures, and never near around those in which they are nearest:
    the same each time.

    Args:
        chain: its own pairs are not looked at.
        home: a posture that is permitted [rad], shape (dof,).
        lower: smallest positions [rad], shape (dof,).
        upper: largest positions [rad], shape (dof,).
    """
    capsules = chain.capsules
    pairs = tuple(
        (one.name, other.name)
        for number, one in enumerate(capsules)
        for other in capsules[number + 1 :]
        if abs(one.frame - other.frame) > 1
    )
    model = CollisionModel(replace(chain, disjoint=pairs))
    nearest, near = np.full(len(pairs), np.inf), np.zeros(len(pairs))
    at, rng = np.zeros((len(pairs), chain.dof)), np.random.default_rng(0)

    def look(postures: Array) -> Array:
        """Note where pairs are nearest; return in how many of the postures each is too near."""
        distances = model.each(postures)[: len(pairs)]
        closest = distances.argmin(axis=1)
        found = distances[np.arange(len(pairs)), closest]
        better = found < nearest
        nearest[better], at[better] = found[better], postures[closest[better]]
        return np.asarray((distances < chain.min_distance).sum(axis=1))

    for batch in np.split(rng.uniform(lower, upper, (_POSTURES, chain.dof)), _POSTURES // _BATCH):
        near += look(batch)
    for share in _AROUND:
        around = np.repeat(at[nearest >= _NEVER], _DRAWS, axis=0)
        around = np.clip(around + share * (upper - lower) * rng.normal(size=around.shape), lower, upper)
        for batch in np.array_split(around, len(around) // _BATCH + 1) if len(around) else ():
            look(batch)
    at_home = model.each(home[None])[: len(pairs), 0]
    may = (at_home >= chain.min_distance) & (nearest < _NEVER) & (near < _ALWAYS * _POSTURES)
    return replace(chain, disjoint=tuple(pair for pair, one in zip(pairs, may, strict=True) if one))


def left_out(chain: ArmChain) -> tuple[tuple[str, str], ...]:
    """Return the pairs of capsules on links that are no neighbours whose distance is not checked."""
    checked = {frozenset(pair) for pair in chain.disjoint}
    capsules = chain.capsules
    return tuple(
        (one.name, other.name)
        for number, one in enumerate(capsules)
        for other in capsules[number + 1 :]
        if abs(one.frame - other.frame) > 1 and frozenset((one.name, other.name)) not in checked
    )
