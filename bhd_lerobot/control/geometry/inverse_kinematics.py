"""From a tool frame to every posture that reaches it, in closed form, for arms of the UR geometry."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import ArmChain
from bhd_lerobot.control.geometry.forward_kinematics import (
    ForwardKinematics,
    UrGeometry,
    components_first,
    components_last,
)

Array = NDArray[np.float64]

BRANCHES = 8
_DOF = 6
_SIGNS = np.array([1.0, -1.0])
_ROUNDING = 1e-12  # what lies beyond the workspace by less is on its border [m^2, or share of it]
_EPSILON = np.finfo(np.float64).eps
_SINE_ZERO = 1e-10  # below this sine of the fifth joint the last one is free: an error of less than this many radians
_TURN = 2 * np.pi
_LEAST = 1e-3  # [m] shorter links have no direction
_AGREES = 1e-9  # [m and 1] frames of a chain and of its closed form


@dataclass(frozen=True, eq=False)
class ClosedForm:
    """The inverse kinematics of a chain whose axes lie as those of a UR, whatever its zeros and directions are.

    Attributes:
        arm: the chain in the convention that the closed form needs.
        base: from the base frame into that of the convention, shape (4, 4); None if they are the same, as are all.
        tool: from the tool frame to the last frame of the convention, shape (4, 4).
        sign: -1 for a joint that turns the other way, shape (6,).
        offset: angles of the convention where the chain's are 0 [rad], shape (6,).
    """

    arm: UrGeometry
    base: Array | None = None
    tool: Array | None = None
    sign: Array | None = None
    offset: Array | None = None

    @classmethod
    def of(cls, forward: ForwardKinematics) -> "ClosedForm | None":
        """Return the closed form of a chain, or None if it has none."""
        return cls(forward.ur) if forward.ur is not None else _recognised(forward)

    def solutions(self, pose: Array, last: Array | float = 0.0) -> Array:
        """Return every posture whose tool frame is `pose`, see `solutions`."""
        return self._own(solutions(self.arm, self.inside(pose), self._last(last)))

    def nearest(self, pose: Array, last: float = 0.0) -> Array:
        """Return for each branch the posture that comes nearest to a pose, see `nearest`."""
        return self._own(nearest(self.arm, self.inside(pose), self._last(last)))

    def inside(self, pose: Array) -> Array:
        """Return a pose of the tool as one of the last frame, both as the convention has them."""
        return pose if self.base is None or self.tool is None else self.base @ pose @ self.tool

    def _last(self, last: Array | float) -> Array | float:
        return last if self.sign is None or self.offset is None else self.sign[-1] * last + self.offset[-1]

    def _own(self, q: Array) -> Array:
        if self.sign is None or self.offset is None:
            return q
        own = self.sign * (q - self.offset)
        return own - _TURN * np.rint(own / _TURN)


def _recognised(forward: ForwardKinematics) -> ClosedForm | None:
    """Return the closed form of six axes: two that meet squarely, two more parallel to the second, and two that follow.

    It is built from the axes, and then has to have the same frames as the chain.
    """
    if forward.dof != _DOF:
        return None
    still = np.zeros(_DOF)
    frames = forward.frames(still)
    frames[0] = forward.base
    z, at = frames[:_DOF, :3, 2].copy(), frames[:_DOF, :3, 3]
    sign = np.ones(_DOF)
    sign[2:4] = np.where(z[2:4] @ z[1] < 0.0, -1.0, 1.0)
    z *= sign[:, None]
    x = np.empty((_DOF + 1, 3))
    x[1], x[4], x[5] = np.cross(z[0], z[1]), np.cross(z[3], z[4]), -np.cross(z[4], z[5])
    shoulder, wrist, end = (_meeting(at[k], z[k], at[k + 1], z[k + 1]) for k in (0, 3, 4))
    elbow, last = (at[k] - (at[k] - shoulder) @ z[1] * z[1] for k in (2, 3))
    x[2], x[3] = elbow - shoulder, last - elbow
    sizes = np.linalg.norm(x[1:6], axis=1)
    if not (sizes > (0.5, _LEAST, _LEAST, 0.5, 0.5)).all():
        return None
    x[1:6] /= sizes[:, None]
    x[0], x[6] = x[1], x[5]
    base, flange = (_frame(x[one], z[two], point) for one, two, point in ((0, 0, shoulder), (_DOF, _DOF - 1, end)))
    offset = np.array([math.atan2(np.cross(x[k], x[k + 1]) @ z[k], x[k] @ x[k + 1]) for k in range(_DOF)])
    square = math.pi / 2
    own = ForwardKinematics(
        ArmChain.from_dh(
            forward.chain.joints,
            a=(0.0, float(sizes[1]), float(sizes[2]), 0.0, 0.0, 0.0),
            d=(0.0, 0.0, 0.0, float((wrist - last) @ z[3]), float((end - wrist) @ z[4]), 0.0),
            alpha=(square, 0.0, 0.0, square, -square, 0.0),
            tool=(0.0, 0.0, 0.0),
            capsules=(),
            disjoint=(),
            min_distance=0.0,
            min_manipulability=0.0,
        )
    )
    if own.ur is None:
        return None
    tool = np.linalg.inv(flange) @ forward.tool(still)
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (16, _DOF))
    if not np.abs(base @ own.tool(sign * q + offset) @ tool - forward.tool(q)).max() < _AGREES:
        return None
    into_base, into_tool = (np.asarray(np.linalg.inv(one), np.float64) for one in (base, tool))
    return ClosedForm(own.ur, into_base, into_tool, sign, offset)


def _meeting(one: Array, way: Array, other: Array, other_way: Array) -> Array:
    """Return the point of a line that is nearest to another one, squarely to it."""
    return np.asarray(one + (other - one) @ (way - (way @ other_way) * other_way) * way)


def _frame(x: Array, z: Array, origin: Array) -> Array:
    frame = np.eye(4)
    frame[:3, 0], frame[:3, 1], frame[:3, 2], frame[:3, 3] = x, np.cross(z, x), z, origin
    return frame


def solutions(arm: UrGeometry, pose: Array, last: Array | float = 0.0) -> Array:
    """Return every posture whose tool frame is `pose`.

    Branches are numbered 4 shoulder + 2 wrist + elbow, where shoulder is 0 if the arm's plane is turned so that the
    wrist lies ahead, wrist is 0 for a positive fifth joint and elbow is 0 for a positive third: along a path without
    singularities a posture stays on its branch.

    Args:
        arm: the geometry.
        pose: tool frames in the base frame, shape (..., 4, 4).
        last: position of the last joint where the pose leaves it free because the fourth and the sixth axis coincide
            [rad], shape (...).

    Returns:
        Joint positions in [-pi, pi] [rad], shape (..., 8, 6); NaN where the branch does not reach the pose.
    """
    q, reached = _branches(arm, components_first(np.asarray(pose, np.float64), 2), last)
    np.copyto(q, np.nan, where=~reached)
    return components_last(q.reshape(_DOF, BRANCHES, *q.shape[4:]).swapaxes(0, 1), 2)


def nearest(arm: UrGeometry, pose: Array, last: Array | float = 0.0) -> Array:
    """Return for each branch the posture with the elbow stretched or folded as far as it takes, shape (8, 6).

    Those that do not reach `pose`, of shape (4, 4), end where the arm ends on the way to it. Only for poses whose wrist
    is far enough from the base's axis.
    """
    return _branches(arm, pose, last)[0].reshape(_DOF, BRANCHES).T


def _branches(arm: UrGeometry, T: Array, last: Array | float) -> tuple[Array, NDArray[np.bool_]]:
    """Return postures, shape (6, 2, 2, 2, ...), and whether they reach T of shape (4, 4, ...), shape (2, 2, 1, ...)."""
    rest = T.shape[2:]
    a2, a3, d1, d4, d5, d6 = arm.a2, arm.a3, arm.d1, arm.d4, arm.d5, arm.d6
    x6, y6, z6 = T[:3, 0], T[:3, 1], T[:3, 2]
    tool_x, tool_y, tool_z = arm.tool
    p5 = T[:3, 3] - (tool_z + d6) * z6
    if tool_x or tool_y:
        p5 = p5 - tool_x * x6 - tool_y * y6

    # Axes 0, 1 and 2 of these arrays are shoulder, wrist and elbow.
    signs = _SIGNS.reshape(2, *(1,) * len(rest))
    sine, cosine = np.empty((2, _DOF, 2, 2, 2, *rest))

    # Shoulder: the wrist's centre lies d4 beside the arm's plane.
    square = p5[0] * p5[0] + p5[1] * p5[1]
    beyond = square - d4 * d4
    reached = beyond > -_ROUNDING
    square = np.maximum(square, d4 * d4)
    along = signs * np.sqrt(np.maximum(beyond, 0.0))
    c1, s1 = (along * p5[0] - d4 * p5[1]) / square, (along * p5[1] + d4 * p5[0]) / square
    cosine[0], sine[0] = c1[:, None, None], s1[:, None, None]

    # Wrist: the parallel axes, (s1, -c1, 0), as the tool sees them.
    u, v, w = (s1 * column[0] - c1 * column[1] for column in (x6, y6, z6))
    sine5 = np.sqrt(u * u + v * v)
    free = sine5 < _SINE_ZERO
    scale = signs / np.where(free, 1.0, sine5)[:, None]
    c6, s6 = scale * u[:, None], -scale * v[:, None]
    if free.any():
        both = np.broadcast_to(free[:, None], c6.shape)
        np.copyto(c6, np.cos(last), where=both)
        np.copyto(s6, np.sin(last), where=both)
    cosine[4], sine[4] = w[:, None, None], (signs * sine5[:, None])[:, :, None]
    cosine[5], sine[5] = c6[:, :, None], s6[:, :, None]

    # Elbow: two links in the arm's plane, to the origin of the fourth frame.
    z4 = [-(s6 * x6[i] + c6 * y6[i]) for i in range(3)]
    c1, s1 = c1[:, None], s1[:, None]
    ahead = (p5[0] - d5 * z4[0]) * c1 + (p5[1] - d5 * z4[1]) * s1
    above = (p5[2] - d1) - d5 * z4[2]
    cosine[3], sine[3] = -z4[2][:, :, None], (z4[0] * c1 + z4[1] * s1)[:, :, None]
    c3 = (ahead * ahead + above * above - (a2 * a2 + a3 * a3)) / (2 * a2 * a3)
    # The smaller the fifth joint's sine, the less is known of the sixth, and with it of where the elbow's links meet.
    unknown = np.where(free, 0.0, _EPSILON / np.maximum(sine5, _SINE_ZERO))
    reached = reached & (np.abs(c3) < 1.0 + _ROUNDING + unknown[:, None])
    c3 = np.minimum(np.maximum(c3, -1.0), 1.0)
    s3 = signs * np.sqrt((1.0 - c3) * (1.0 + c3))[:, :, None]
    cosine[2], sine[2] = c3[:, :, None], s3
    forearm, upper = a3 * s3, (a2 + a3 * c3)[:, :, None]
    ahead, above = ahead[:, :, None], above[:, :, None]
    cosine[1], sine[1] = ahead * upper + above * forearm, above * upper - ahead * forearm

    q: Array = np.arctan2(sine, cosine)
    fourth = q[3]  # so far the sum of the parallel joints
    fourth -= q[1] + q[2]
    fourth -= (2 * np.pi) * np.rint(fourth / (2 * np.pi))
    return q, reached[:, :, None]


def wrist_centre(arm: UrGeometry, pose: Array) -> Array:
    """Return where the last two axes meet if the tool frame is `pose` of shape (4, 4), shape (3,) [m]."""
    x, y, z = arm.tool
    return pose[:3, 3] - x * pose[:3, 0] - y * pose[:3, 1] - (z + arm.d6) * pose[:3, 2]
