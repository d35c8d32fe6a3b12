"""Straight lines as fast as the joints permit: every limit kept at every tick, and how near to the shortest time."""

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from bhd_lerobot.control.motion.command_check import MAX_TOOL_ACCELERATION, MAX_TOOL_SPEED
from bhd_lerobot.control.motion.line import Line, ToolLimits, along_line
from bhd_lerobot.control.motion.path_timing import PathLimits, PathTimer, follow
from bhd_lerobot.control.motion.trajectory import MotionLimits, PlanFailure, State
from tests.control.goal_rig import ARM, HZ, KINEMATICS
from tests.control.motion.test_trajectory import excess

LIMITS = MotionLimits.of(ARM.limits)[slice(0, 6)]
HOME = np.array(ARM.arm.home[:6])
BOX = np.array([[0.30, -0.35, 0.10], [0.65, 0.35, 0.50]])  # [m]


def test_random_lines_keep_every_limit_and_are_nearly_as_quick_as_one_without_a_limit_of_the_jerk() -> None:
    rng, posture, ratios = np.random.default_rng(1), HOME, []
    while len(ratios) < 10:
        goal = KINEMATICS.tool(posture)
        goal[:3, 3] = rng.uniform(*BOX)
        goal[:3, :3] = goal[:3, :3] @ Rotation.from_rotvec(rng.uniform(-0.5, 0.5, 3)).as_matrix()
        tool = ToolLimits(MAX_TOOL_SPEED, MAX_TOOL_ACCELERATION)
        motion = along_line(posture, goal, KINEMATICS, (LIMITS, tool), HZ)
        if isinstance(motion, PlanFailure):
            continue
        line = Line(KINEMATICS.tool(posture), goal)
        assert excess(State.at_rest(posture), motion, LIMITS) < 1e-9
        position = np.concatenate((posture[None], motion.position))
        velocity, acceleration = (
            np.concatenate((np.zeros((1, 6)), one)) for one in (motion.velocity, motion.acceleration)
        )
        assert np.allclose(np.diff(position, axis=0) * HZ, (velocity[1:] + velocity[:-1]) / 2, atol=2e-4)
        assert np.allclose(np.diff(velocity, axis=0) * HZ, (acceleration[1:] + acceleration[:-1]) / 2, atol=0.05)
        assert not velocity[-1].any()
        assert not acceleration[-1].any()
        # On the line, only forward, turning evenly, and no faster than the tool may be.
        frames, turn = KINEMATICS.tool(position), line.start[:3, :3].T
        assert np.abs(frames[-1] - goal).max() < 1e-9
        tools = frames[:, :3, 3] - line.start[:3, 3]
        way = (goal[:3, 3] - line.start[:3, 3]) / line.length
        assert np.linalg.norm(tools - np.outer(tools @ way, way), axis=1).max() < 3e-5
        along = np.diff(tools @ way) * HZ
        assert along.min() > -1e-6
        assert along.max() <= MAX_TOOL_SPEED + 1e-6
        assert np.abs(np.diff(along, prepend=0.0)).max() * HZ <= MAX_TOOL_ACCELERATION * 1.01 + 1e-3
        share = tools @ way / line.length
        turned, whole = (Rotation.from_matrix(turn @ one[..., :3, :3]).as_rotvec() for one in (frames, goal))
        assert np.abs(turned - share[:, None] * whole).max() < 1e-4
        kept = np.concatenate(((True,), np.diff(share) > 1e-9))
        ratios.append(motion.ticks / HZ / bound(share[kept], position[kept]))
        posture = motion.target
    assert np.median(ratios) < 1.3
    assert max(ratios) < 1.7


def bound(share: np.ndarray, postures: np.ndarray) -> float:
    """Return how long the way takes without limits of the jerk, and of the tool [s]."""
    limits = PathLimits(LIMITS.velocity, LIMITS.acceleration, LIMITS.jerk)
    found = PathTimer(CubicSpline(share / share[-1], postures), limits).bound()
    assert found is not None
    return found


def test_one_joint_takes_as_long_as_is_known() -> None:
    """From rest to rest: without a jerk limit by a triangle or a trapezium of speed, with one by the seven phases."""
    path = CubicSpline([0.0, 0.5, 1.0], np.array([[0.0], [0.5], [1.0]]))
    for speed, change, jerk in ((10.0, 8.0, 80.0), (0.5, 8.0, 80.0), (1.5, 4.0, 100.0)):
        timer = PathTimer(path, PathLimits(*(np.array([value]) for value in (speed, change, jerk))))
        triangle = speed**2 > change
        least = 2 / np.sqrt(change) if triangle else 1 / speed + speed / change
        assert timer.bound() == pytest.approx(least, rel=0.02)
        ramp = change / jerk
        known = ramp + np.sqrt(ramp**2 + 4 / change) if triangle else 1 / speed + speed / change + ramp
        timing = timer.find()
        assert timing is not None
        assert timing.duration == pytest.approx(known, rel=0.06)
        times = np.linspace(0.0, timing.duration, 200)
        position, velocity, acceleration, _ = follow(path, timing.share, times)
        assert position[[0, -1], 0].tolist() == pytest.approx([0.0, 1.0])
        assert velocity.min() > -1e-6
        assert velocity.max() < 1.03 * speed
        assert np.abs(acceleration).max() < 1.15 * change
        assert acceleration[[0, -1], 0].tolist() == pytest.approx([0.0, 0.0], abs=1e-6)
