"""How long straight lines of the UR5's tool take, beside TOPP-RA: `python -m benchmarks.lines`.

Random lines, one after the other, at two speeds of the tool. The peer's times have the same limits of velocity and
acceleration, of the joints and of the tool, but none of the jerk: no law with one can be as quick. Exits with 3 if a
goal is missed.
"""

import sys
import time

import numpy as np
import toppra
from scipy.interpolate import CubicSpline
from toppra.algorithm import TOPPRA
from toppra.constraint import JointAccelerationConstraint, JointVelocityConstraint

from benchmarks._report import Report, parse_options
from bhd_lerobot.control.motion.command_check import MAX_TOOL_ACCELERATION, MAX_TOOL_SPEED
from bhd_lerobot.control.motion.line import ToolLimits, along_line
from bhd_lerobot.control.motion.planner import GoalPlanner
from bhd_lerobot.control.motion.trajectory import MotionLimits, PlanFailure, Trajectory
from bhd_lerobot.robots.config_ur import UR5Config

GOAL = 1.15
_BOX = np.array([[0.30, -0.35, 0.10], [0.65, 0.35, 0.50]])  # where lines begin and end [m]


def main() -> int:
    """Measure both, print the table, return 0 if the goal is met."""
    args = parse_options(__doc__, lines=200, seed=0)
    toppra.setup_logging("ERROR")
    report = Report(f"{args.lines} lines each, seed {args.seed}")
    for speed in (0.25, MAX_TOOL_SPEED):
        ours, peers, planning = measure(speed, args.lines, args.seed)
        ratios, middle = ours / peers, np.median(ours / peers)
        times = f"{np.median(ours):.3f} s, TOPP-RA {np.median(peers):.3f} s"
        report.add(f"{speed} m/s: median time", f"{times}; planned in {np.median(planning) * 1e3:.1f} ms")
        spread = f"median {middle:.3f}, 90 % below {np.percentile(ratios, 90):.2f}, worst {ratios.max():.2f}"
        report.add(f"{speed} m/s: ours / TOPP-RA", spread, f"median at most {GOAL}", met=middle <= GOAL)
    return report.end(args.json)


def measure(speed: float, lines: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return how long lines take, how long with TOPP-RA, and how long they were planned [s], each of shape (lines,)."""
    arm = UR5Config().body()
    hz = arm.control_hz
    planner, rng = GoalPlanner(arm, hz), np.random.default_rng(seed)
    limits = planner.limits[slice(0, planner.dof)], ToolLimits(speed, MAX_TOOL_ACCELERATION)
    posture = np.array(arm.arm.home[: planner.dof])
    times: list[tuple[float, float, float]] = []
    while len(times) < lines:
        goal = planner.kinematics.tool(posture)
        length = -goal[:3, 3].copy()
        goal[:3, 3] = rng.uniform(*_BOX)
        length += goal[:3, 3]
        turn = rng.uniform(-0.5, 0.5)
        c, s = np.cos(turn), np.sin(turn)
        goal[:3, :3] = goal[:3, :3] @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        started = time.perf_counter()
        motion = along_line(posture, goal, planner.kinematics, limits, hz)
        seconds = time.perf_counter() - started
        if isinstance(motion, PlanFailure):
            continue  # some lines pass the base or a singular posture and are refused
        peer = topp(motion, posture, planner, limits, float(np.linalg.norm(length)))
        times.append((motion.ticks / hz, peer, seconds))
        posture = motion.target
    ours, peers, planning = np.array(times).T
    return ours, peers, planning


def topp(
    motion: Trajectory,
    start: np.ndarray,
    planner: GoalPlanner,
    limits: tuple[MotionLimits, ToolLimits],
    length: float,
) -> float:
    """Return how long TOPP-RA takes along the way of a trajectory [s]."""
    postures = np.concatenate((start[None], motion.position))
    tool = planner.kinematics.tool(postures)[:, :3, 3]
    share = np.linalg.norm(tool - tool[0], axis=1) / length
    kept = np.concatenate(((True,), np.diff(share) > 1e-9))
    kept &= (np.arange(len(kept)) % max(1, len(kept) // 200) == 0) | (share == share[-1])
    joints, tool_limits = limits
    # The tool is one joint more, which moves evenly.
    way = CubicSpline(share[kept] / share[kept][-1], np.column_stack((postures, share * length))[kept])
    grid = np.linspace(0.0, 1.0, 401)
    path = toppra.SplineInterpolator(grid, way(grid))
    velocity = np.append(joints.velocity, tool_limits.velocity)
    acceleration = np.append(joints.acceleration, tool_limits.acceleration)
    constraints = [
        JointVelocityConstraint(np.column_stack((-velocity, velocity))),
        JointAccelerationConstraint(np.column_stack((-acceleration, acceleration))),
    ]
    found = TOPPRA(constraints, path, gridpoints=grid, solver_wrapper="seidel").compute_trajectory(0, 0)
    return float(found.duration)


if __name__ == "__main__":
    sys.exit(main())
