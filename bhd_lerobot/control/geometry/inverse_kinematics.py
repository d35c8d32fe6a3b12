"""From a tool frame to every posture that reaches it, in closed form, for arms of the UR geometry."""

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.control.geometry.forward_kinematics import UrGeometry, components_first, components_last

Array = NDArray[np.float64]

BRANCHES = 8
_DOF = 6
_SIGNS = np.array([1.0, -1.0])
_ROUNDING = 1e-12  # what lies beyond the workspace by less is on its border [m^2, or share of it]
_SINE_ZERO = 1e-10  # below this sine of the fifth joint the last one is free: an error of less than this many radians


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


def nearest(arm: UrGeometry, pose: Array, last: float = 0.0) -> Array:
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
        free = np.broadcast_to(free[:, None], c6.shape)
        np.copyto(c6, np.cos(last), where=free)
        np.copyto(s6, np.sin(last), where=free)
    cosine[4], sine[4] = w[:, None, None], (signs * sine5[:, None])[:, :, None]
    cosine[5], sine[5] = c6[:, :, None], s6[:, :, None]

    # Elbow: two links in the arm's plane, to the origin of the fourth frame.
    z4 = [-(s6 * x6[i] + c6 * y6[i]) for i in range(3)]
    c1, s1 = c1[:, None], s1[:, None]
    ahead = (p5[0] - d5 * z4[0]) * c1 + (p5[1] - d5 * z4[1]) * s1
    above = (p5[2] - d1) - d5 * z4[2]
    cosine[3], sine[3] = -z4[2][:, :, None], (z4[0] * c1 + z4[1] * s1)[:, :, None]
    c3 = (ahead * ahead + above * above - (a2 * a2 + a3 * a3)) / (2 * a2 * a3)
    reached = reached & (np.abs(c3) < 1.0 + _ROUNDING)
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
