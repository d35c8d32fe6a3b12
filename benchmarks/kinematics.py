"""Inverse kinematics of the UR5, ours beside its peers, on the same poses: `python -m benchmarks.kinematics`.

Every pose is the tool frame of a random posture that our checks admit. Iterative peers, and our numeric solution for
arms without a closed form, start near that posture and end at 1e-6 m and rad. The goal: ours solves at least 99.9 % of
the poses, and is faster than each peer that iterates. Exits with 3 if it is missed.
"""

import math
import sys
import time
from collections.abc import Callable
from dataclasses import replace

import mink
import mujoco
import numpy as np
import pink
import pinocchio
from eaik.IK_DH import DhRobot

from benchmarks._report import Report, parse_options
from benchmarks._turns import seconds
from bhd_lerobot.bodies.body import ArmChain, Placement
from bhd_lerobot.bodies.ur import ur5
from bhd_lerobot.control.commands import ResultCode
from bhd_lerobot.control.geometry.kinematics import ArmKinematics
from bhd_lerobot.control.geometry.numeric_inverse import NumericInverse

try:
    import ur_analytic_ik  # has no wheels for every platform
except ImportError:
    ur_analytic_ik = None

TOLERANCE = 1e-6  # [m] and [rad]
SEED_DISTANCE = 0.3  # of each joint of the iterative peers' seed from a solution, at most [rad]
MOST_STEPS = 100
GOAL = 0.999
BATCH = 10_000

Solver = Callable[[np.ndarray, np.ndarray], np.ndarray]


def main() -> int:
    """Measure, print the table, return 0 if the goal is met."""
    args = parse_options(__doc__, poses=1000, seed=0)
    arm = ur5()
    kinematics = ArmKinematics(arm.arm.chain, arm.limits)
    general = ArmKinematics(without_closed_form(arm.arm.chain), arm.limits)
    descent = NumericInverse(general, general.lower, general.upper)
    rng = np.random.default_rng(args.seed)
    postures = admissible(kinematics, rng, args.poses)
    poses = np.ascontiguousarray(kinematics.tool(postures))
    seeds = postures + rng.uniform(-SEED_DISTANCE, SEED_DISTANCE, postures.shape)
    closed = {"ours, closed form": lambda pose, seed: kinematics.solutions(pose), "eaik": eaik_solver(arm.arm.chain)}
    if ur_analytic_ik is not None:
        closed["ur_analytic_ik"] = ur_solver(arm.arm.chain)
    iterative = {"pink": pink_solver(arm.arm.chain), "mink": mink_solver(arm.arm.chain)}
    solvers = {
        "ours, all checks": lambda pose, seed: kinematics.solve(pose, seed).postures,
        "ours, numeric, all checks": lambda pose, seed: general.solve(pose, seed).postures,
        "ours, numeric, from the seed": lambda pose, seed: descent.descend(pose, seed, seed[None])[0],
        **closed,
        **iterative,
    }

    times = {name: np.empty(len(poses)) for name in solvers}
    solved = {name: np.zeros(len(poses), np.bool_) for name in solvers}
    for index, (pose, seed) in enumerate(zip(poses, seeds, strict=True)):
        for name, solver in solvers.items():
            started = time.perf_counter()
            answer = solver(pose, seed)
            times[name][index] = time.perf_counter() - started
            solved[name][index] = reaches(kinematics, answer, pose)
    batch = np.resize(poses, (BATCH, 4, 4))
    batched = float(np.median([seconds(lambda: kinematics.solutions(batch)) for _ in range(20)])) / BATCH

    report = Report(
        f"{len(poses)} poses of random admissible postures, seed {args.seed}; solved: {TOLERANCE} m and rad. Iterative "
        f"peers start within {SEED_DISTANCE} rad of a solution and take {MOST_STEPS} steps at most"
    )
    base = float(np.median(times["ours, all checks"]))
    for name in solvers:
        median, slow = (float(np.percentile(times[name], share)) for share in (50, 90))
        value = f"median {median * 1e6:.1f} us, 90 % below {slow * 1e6:.1f} us, {median / base:.2f} of all checks"
        goal, met = ("slower than ours", median > base) if name in iterative else ("", None)
        report.add(name, value, goal, met=met)
        share = solved[name].mean()
        goal, met = (f"at least {100 * GOAL:.1f} %", share >= GOAL) if name.startswith("ours") else ("", None)
        report.add(f"{name}: solved", f"{100 * share:.2f} %", goal, met=met)
    report.add(f"ours, {BATCH} at once", f"{batched * 1e6:.2f} us, {batched / base:.4f} of all checks")
    return report.end(args.json)


def without_closed_form(chain: ArmChain) -> ArmChain:
    """Return the arm with one axis tilted by a ten millionth of a radian: it is solved as any other chain."""
    tilt = np.eye(4)
    tilt[0, 2], tilt[2, 0] = 1e-7, -1e-7
    second = Placement.of(chain.links[1].matrix() @ tilt)
    return replace(chain, links=(chain.links[0], second, *chain.links[2:]))


def admissible(kinematics: ArmKinematics, rng: np.random.Generator, count: int) -> np.ndarray:
    """Return random postures that pass every check, shape (count, 6)."""
    found = np.empty((0, 6))
    while len(found) < count:
        drawn = rng.uniform(-math.pi, math.pi, (4 * count, 6))
        found = np.concatenate((found, drawn[kinematics.check(drawn) == ResultCode.SUCCEEDED]))
    return found[:count]


def reaches(kinematics: ArmKinematics, answer: np.ndarray, pose: np.ndarray) -> bool:
    """Return whether one of the postures, shape (k, 6), reaches the pose."""
    found = kinematics.tool(answer.reshape(-1, 6))
    turned = np.linalg.norm(found[:, :3, :3] - pose[:3, :3], axis=(1, 2)) / math.sqrt(2)
    error = np.maximum(turned, np.linalg.norm(found[:, :3, 3] - pose[:3, 3], axis=1))
    return bool((error < TOLERANCE).any())


def eaik_solver(chain: ArmChain) -> Solver:
    """Return EAIK's closed form; taking the tool off belongs to its time."""
    a, _, d = np.array([link.position for link in chain.links]).T
    alpha = np.array([math.atan2(link.rotation[2][1], link.rotation[1][1]) for link in chain.links])
    robot, flange_from_tool = DhRobot(alpha, a, d), np.linalg.inv(chain.tool.matrix())
    return lambda pose, seed: np.asarray(robot.IK(pose @ flange_from_tool).Q)


def ur_solver(chain: ArmChain) -> Solver:
    """Return ur_analytic_ik's closed form, which has the UR5's numbers built in."""
    tool = chain.tool.matrix()
    return lambda pose, seed: np.array(ur_analytic_ik.ur5.inverse_kinematics_with_tcp(pose, tool)).reshape(-1, 6)


def pink_solver(chain: ArmChain) -> Solver:
    """Return Pink's differential inverse kinematics, iterated with full steps."""
    model, parent, placement = pinocchio.Model(), 0, pinocchio.SE3(chain.base.matrix())
    effort, speed, lower, upper = (np.array([value]) for value in (100.0, 1e3, -2 * math.pi - 1, 2 * math.pi + 1))
    for name, link in zip(chain.joints, chain.links, strict=True):
        joint = pinocchio.JointModelRZ()
        parent = model.addJoint(parent, joint, placement, name, effort, speed, lower, upper)
        placement = pinocchio.SE3(link.matrix())
    placement = placement * pinocchio.SE3(chain.tool.matrix())
    model.addFrame(pinocchio.Frame("tool", parent, placement, pinocchio.FrameType.OP_FRAME))
    data = model.createData()
    task = pink.FrameTask("tool", position_cost=1.0, orientation_cost=1.0, lm_damping=1e-3)

    def solve(pose: np.ndarray, seed: np.ndarray) -> np.ndarray:
        configuration = pink.Configuration(model, data, seed)
        task.set_target(pinocchio.SE3(pose[:3, :3], pose[:3, 3]))
        for _ in range(MOST_STEPS):
            if np.abs(task.compute_error(configuration)).max() < TOLERANCE / 2:
                break
            velocity = pink.solve_ik(configuration, [task], 1.0, solver="daqp", safety_break=False)
            configuration.integrate_inplace(velocity, 1.0)
        return configuration.q

    return solve


def mink_solver(chain: ArmChain) -> Solver:
    """Return mink's differential inverse kinematics, iterated with full steps."""
    configuration = mink.Configuration(mujoco.MjModel.from_xml_string(mjcf(chain)))
    task = mink.FrameTask("tool", "site", position_cost=1.0, orientation_cost=1.0, lm_damping=1e-3)

    def solve(pose: np.ndarray, seed: np.ndarray) -> np.ndarray:
        configuration.update(seed)
        task.set_target(mink.SE3.from_matrix(pose))
        for _ in range(MOST_STEPS):
            if np.abs(task.compute_error(configuration)).max() < TOLERANCE / 2:
                break
            velocity = mink.solve_ik(configuration, [task], 1.0, solver="daqp", damping=1e-12)
            configuration.integrate_inplace(velocity, 1.0)
        return configuration.q.copy()

    return solve


def mjcf(chain: ArmChain) -> str:
    """Return the chain as a MuJoCo model: bodies with joints and a site, and masses because it wants some."""
    bodies, places = "", [place_of(link) for link in (chain.base, *chain.links, chain.tool)]
    for name, place in zip(chain.joints, places, strict=False):
        bodies += (
            f'<body name="{name}" {place}>'
            f'<joint name="{name}" axis="0 0 1" range="-7.3 7.3"/><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'
        )
    site = f'<body {places[-2]}><site name="tool" {places[-1]}/></body>'
    return (
        '<mujoco><compiler angle="radian" autolimits="true"/>'
        f"<worldbody>{bodies}{site}{'</body>' * len(chain.joints)}</worldbody></mujoco>"
    )


def place_of(place: Placement) -> str:
    """Return MuJoCo's attributes of a placement."""
    numbers = [*place.matrix()[:3, 0].tolist(), *place.matrix()[:3, 1].tolist()]
    return f'pos="{" ".join(map(str, place.position))}" xyaxes="{" ".join(map(str, numbers))}"'


if __name__ == "__main__":
    sys.exit(main())
