"""From a tool frame to postures that reach it, for any chain: damped least squares from several starts.

What is made small is the sum of the squared distance of the tool centre point and of the squared differences of the
axes' directions, times a length. An arm with fewer than six joints reaches the position exactly, and of the orientation
what is left to it: the direction of the tool's z axis, along which it approaches, counts a hundred times as much as
those of x and y. One with more than six joints stays as near as it can to the posture that it is solved from.
"""

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.control.geometry.chain import find_frames, find_jacobian, solve
from bhd_lerobot.control.geometry.forward_kinematics import ForwardKinematics
from bhd_lerobot.control.kernels import clamp, kernel
from bhd_lerobot.control.record import ARM, GEOMETRY, JOINTS

Array = NDArray[np.float64]

STARTS = 16
"""Postures that are started from: the one now, the middle of the ranges, those of a fixed sample that come nearest."""
MOST_STARTS = 64
"""How many are tried before a pose counts as out of reach."""
REACHED = 1e-6  # [m and rad]
REACHED_POSITION = 1e-4  # [m] by an arm with fewer than six joints
_POSE = 6
_SAMPLE = 4000
_LENGTH = 0.25  # of the reach [m/rad]
_AROUND = 0.01  # how much the directions of x and y count for an arm with fewer than six joints
_LATER = 1e-4  # how much the orientation counts once the position is reached, for such an arm
_PULL = 1e-4  # how much a radian from the posture now counts for an arm with more than six, times the length squared
_MOST_STEPS, _LAST_STEPS = 60, 12
_DAMPING, _LEAST, _MOST = 1e-3, 1e-13, 1e6  # times the length squared
_EASIER, _HARDER = 0.1, 6.0
_DONE = 1e-11  # [m] and times the length [rad]: it is there
_STILL, _NEARLY = 1e-9, 1e-4  # [rad] a step that is shorter than this is none; and before the last descent


class NumericInverse:
    """Finds postures of one arm.

    Args:
        forward: the arm.
        lower: smallest positions [rad], shape (dof,).
        upper: largest positions [rad], shape (dof,).
    """

    def __init__(self, forward: ForwardKinematics, lower: Array, upper: Array) -> None:
        self.dof, self._lower, self._upper = forward.dof, lower, upper
        self._unlimited = np.array([np.full(self.dof, -np.inf), np.full(self.dof, np.inf)])
        low, high = np.maximum(lower, -np.pi), np.minimum(upper, np.pi)
        low, high = np.where(low < high, low, lower), np.where(low < high, high, upper)
        drawn = np.random.default_rng(0).uniform(low, high, (_SAMPLE, self.dof))
        self._sample = np.concatenate((((low + high) / 2)[None], drawn))
        self._length = _LENGTH * forward.chain.reach
        self._scale = np.array([*[math.sqrt(0.5) * self._length] * 3, 1.0])
        tools = self._scaled(forward.tool(self._sample))
        self._tools, self._squares = tools, np.square(tools).sum(axis=1)
        self._geometry = np.zeros(1, GEOMETRY)
        forward.fill(self._geometry[0])
        find_posture.load()  # now, and not for the first goal on the wall clock

    def starts(self, pose: Array, posture: Array) -> Array:
        """Return postures to start from, the most promising first, shape (MOST_STARTS, dof)."""
        far = self._squares - 2 * (self._tools @ self._scaled(pose[None])[0])
        far[0] = -np.inf
        near = np.argpartition(far, MOST_STARTS)[: MOST_STARTS - 1]
        return np.concatenate((posture[None], self._sample[near[far[near].argsort(kind="stable")]]))

    def descend(self, pose: Array, posture: Array, starts: Array, *, limited: bool = True) -> tuple[Array, Array]:
        """Return the postures that descents end in, and by what they miss the pose.

        Args:
            pose: shape (4, 4).
            posture: where the arm is [rad], shape (dof,).
            starts: shape (k, dof).
            limited: whether the joints keep within their limits.

        Returns:
            Postures of shape (k, dof), and what each is off by, shape (k, 3): a distance [m], an angle [rad], and the
            root of the squared differences of the axes' directions, each counted as above [1].
        """
        target, posture = np.ascontiguousarray(pose[:3]), np.ascontiguousarray(posture)
        found, off = starts.copy(), np.empty((len(starts), 3))
        lower, upper = (self._lower, self._upper) if limited else (self._unlimited[0], self._unlimited[1])
        room, tool = np.zeros((2 * JOINTS + 3, JOINTS)), np.zeros((3, 4))  # new ones: threads may share the arm
        arm, geometry = np.zeros(1, ARM), self._geometry
        for q, miss in zip(found, off, strict=True):
            find_posture.run(q, posture, target, lower, upper, self._length, room, tool, miss, arm, geometry)
        return found, off

    def reaches(self, off: Array) -> NDArray[np.bool_]:
        """Return which postures count as solutions: an arm with fewer than six joints may be turned."""
        if self.dof < _POSE:
            return np.asarray(off[:, 0] < REACHED_POSITION)
        return np.asarray((off[:, :2] < REACHED).all(axis=1))

    def search(self, pose: Array, posture: Array) -> Iterator[tuple[Array, Array]]:
        """Yield what descents from a few starts end in that reach a pose, and from many; see `descend`.

        If nothing reaches it within the limits, then without them.
        """
        starts = self.starts(pose, posture)
        found, off = self.descend(pose, posture, starts[:STARTS])
        yield found[self.reaches(off)], off[self.reaches(off)]
        more = self.descend(pose, posture, starts[STARTS:])
        found, off = np.concatenate((found, more[0])), np.concatenate((off, more[1]))
        if not self.reaches(off).any():
            found, off = self.descend(pose, posture, starts[:STARTS], limited=False)
        yield found[self.reaches(off)], off[self.reaches(off)]

    def nearest(self, pose: Array, posture: Array) -> tuple[float, float]:
        """Return by what the nearest posture that is found misses a pose [m, rad]."""
        _, off = self.descend(pose, posture, self.starts(pose, posture)[:STARTS])
        distance, angle, _ = off[(off[:, :2] @ (1.0, self._length)).argmin()].tolist()
        return distance, angle

    def _scaled(self, poses: Array) -> Array:
        """Return what the squared difference of two poses is made of, shape (n, 12)."""
        return np.asarray((poses[:, :3] * self._scale).reshape(-1, 12))


@kernel(
    "int64(float64[::1], float64[::1], float64[:, ::1], float64[::1], float64[::1], float64, float64[:, ::1], "
    "float64[:, ::1], float64[::1], arm[::1], geometry[::1])"
)
def find_posture(  # noqa: PLR0917
    q: Array,
    near: Array,
    target: Array,
    lower: Array,
    upper: Array,
    length: float,
    room: Array,
    tool: Array,
    off: Array,
    arms: Any,
    geometries: Any,
) -> int:
    """Move a posture to one whose tool frame is as near as can be to a target; return the number of steps.

    Args:
        length: what a radian counts for [m].
        off: for what it misses the target by, see `NumericInverse.descend`.
    """
    arm, geometry, square = arms[0], geometries[0], length * length
    for k in range(geometry.dof):
        q[k] = clamp(q[k], lower[k], upper[k])
    equal, steps = (0.5 * square, 0.5 * square, 0.0), 0
    if geometry.dof > _POSE:
        pulled = (0.5 * square, 0.5 * square, _PULL * square)
        steps += descend(q, near, target, lower, upper, pulled, square, _MOST_STEPS, _NEARLY, room, tool, arm, geometry)
    if geometry.dof >= _POSE:
        steps += descend(q, near, target, lower, upper, equal, square, _MOST_STEPS, _STILL, room, tool, arm, geometry)
    else:
        first, later = (_AROUND * square, square, 0.0), (_AROUND * _LATER * square, _LATER * square, 0.0)
        steps += descend(q, near, target, lower, upper, first, square, _MOST_STEPS, _NEARLY, room, tool, arm, geometry)
        steps += descend(q, near, target, lower, upper, later, square, _MOST_STEPS, _STILL, room, tool, arm, geometry)
        place = (0.0, 0.0, 0.0)
        steps += descend(q, near, target, lower, upper, place, square, _LAST_STEPS, _STILL, room, tool, arm, geometry)
    find_frames(arm, geometry, q)
    off[0] = math.sqrt(misfit(q, near, target, (0.0, 0.0, 0.0), tool, arm, geometry))
    turn = misfit(q, near, target, (1.0, 1.0, 0.0), tool, arm, geometry) - off[0] * off[0]
    off[1] = 2.0 * math.asin(math.sqrt(clamp(turn / 8.0, 0.0, 1.0)))  # of the squared differences of three axes
    around = 1.0 if geometry.dof >= _POSE else _AROUND
    turn = misfit(q, near, target, (around, 1.0, 0.0), tool, arm, geometry) - off[0] * off[0]
    off[2] = math.sqrt(max(turn, 0.0))
    return steps


@kernel()
def squared(value: float) -> float:
    """Return the square of a number."""
    return value * value


@kernel()
def misfit(  # noqa: PLR0917
    q: Array, near: Array, target: Array, weights: tuple[float, float, float], tool: Array, arm: Any, geometry: Any
) -> float:
    """Return what is made small [m^2], and write the tool frame; the frames are those of the posture."""
    last, own, dof = arm.frames[geometry.dof], geometry.tool, geometry.dof
    total = 0.0
    for i in range(3):
        for j in range(4):
            tool[i, j] = last[i, 0] * own[0, j] + last[i, 1] * own[1, j] + last[i, 2] * own[2, j]
        tool[i, 3] += last[i, 3]
        total += squared(target[i, 3] - tool[i, 3])
        for j in range(3):
            total += (weights[1] if j == 2 else weights[0]) * squared(target[i, j] - tool[i, j])
    for k in range(dof):
        total += weights[2] * squared(near[k] - q[k])
    return total


@kernel()
def descend(  # noqa: PLR0912, PLR0917
    q: Array,
    near: Array,
    target: Array,
    lower: Array,
    upper: Array,
    weights: tuple[float, float, float],
    square: float,
    most: int,
    still: float,
    room: Array,
    tool: Array,
    arm: Any,
    geometry: Any,
) -> int:
    """Take Levenberg's and Marquardt's steps within the joints' limits until the misfit becomes no smaller.

    A joint at its limit that would go on is held for a step.
    """
    dof, whole, matrix = geometry.dof, room[:JOINTS], room[JOINTS : 2 * JOINTS]
    side, trial, slope = room[2 * JOINTS], room[2 * JOINTS + 1], room[2 * JOINTS + 2]
    damping = _DAMPING * square
    find_jacobian(arm, geometry, q)
    before = misfit(q, near, target, weights, tool, arm, geometry)
    for step in range(most):
        if before < _DONE * _DONE:
            return step
        # What the orientation adds: of each axis u that should be t, the torque u x t and the inertia 1 - u u'.
        jacobian = arm.jacobian
        for k in range(dof):
            slope[k] = weights[2] * (near[k] - q[k])
            for i in range(3):
                slope[k] += jacobian[i, k] * (target[i, 3] - tool[i, 3])
        for j in range(3):
            weight = weights[1] if j == 2 else weights[0]
            ux, uy, uz = tool[0, j], tool[1, j], tool[2, j]
            tx, ty, tz = target[0, j], target[1, j], target[2, j]
            cx, cy, cz = weight * (uy * tz - uz * ty), weight * (uz * tx - ux * tz), weight * (ux * ty - uy * tx)
            for k in range(dof):
                slope[k] += jacobian[3, k] * cx + jacobian[4, k] * cy + jacobian[5, k] * cz
        for k in range(dof):
            for m in range(k + 1):
                whole[k, m] = normal(arm, weights, tool, k, m)
            whole[k, k] += weights[2]
        improved = False
        while not improved:
            for k in range(dof):
                side[k] = slope[k]
                for m in range(k + 1):
                    matrix[k, m] = whole[k, m]
                matrix[k, k] += damping
            for k in range(dof):
                if (q[k] <= lower[k] and slope[k] < 0.0) or (q[k] >= upper[k] and slope[k] > 0.0):
                    for m in range(dof):
                        matrix[max(k, m), min(k, m)] = 0.0
                    matrix[k, k], side[k] = 1.0, 0.0
            solve(matrix, side, dof)
            longest = 0.0
            for k in range(dof):
                trial[k] = clamp(q[k] + side[k], lower[k], upper[k])
                longest = max(longest, abs(trial[k] - q[k]))
            if not longest > still:
                return step
            find_frames(arm, geometry, trial)
            after = misfit(trial, near, target, weights, tool, arm, geometry)
            improved = after < before
            if not improved:
                damping *= _HARDER
                if damping > _MOST * square:
                    return step
        for k in range(dof):
            q[k] = trial[k]
        before = after
        damping = max(damping * _EASIER, _LEAST * square)
        find_jacobian(arm, geometry, q)
    return most


@kernel()
def normal(arm: Any, weights: tuple[float, float, float], tool: Array, k: int, m: int) -> float:
    """Return an element of the normal equations' matrix: of what joints k and m do to the tool."""
    jacobian = arm.jacobian
    total = spin = 0.0
    for i in range(3):
        total += jacobian[i, k] * jacobian[i, m]
        spin += jacobian[i + 3, k] * jacobian[i + 3, m]
    for j in range(3):
        one = tool[0, j] * jacobian[3, k] + tool[1, j] * jacobian[4, k] + tool[2, j] * jacobian[5, k]
        other = tool[0, j] * jacobian[3, m] + tool[1, j] * jacobian[4, m] + tool[2, j] * jacobian[5, m]
        total += (weights[1] if j == 2 else weights[0]) * (spin - one * other)
    return total
