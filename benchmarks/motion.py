"""How precisely the simulated UR5 moves: `python -m benchmarks.motion`.

Straight lines of the tool at 0.25 m/s in random directions: the largest distance of the measured tool from its line,
with an empty gripper. Joint goals at full speed: the time from the end of the trajectory until every joint stays within
the goal tolerance, 0.002 rad, and slower than 0.01 rad/s. Exits with 3 if a goal is missed.
"""

import sys

import numpy as np
from numpy.typing import NDArray

from benchmarks._report import Report, parse_options
from bhd_lerobot.bodies.tabletop import TableScene
from bhd_lerobot.control.commands import BrainCommand, Pose, ResultCode
from bhd_lerobot.control.geometry.poses import pose_vectors
from bhd_lerobot.robots.config_ur import UR5Config
from bhd_lerobot.robots.host.simulation import Simulation

PATH_GOAL_M, SETTLE_GOAL_S = 0.001, 0.2
SPEED = 0.25  # [m/s]
_BOX = np.array([[0.30, -0.35, 0.10], [0.65, 0.35, 0.50]])  # where lines begin and end [m]
_TOLERANCE, _STILL = 0.002, 0.01  # [rad], the goals' own; [rad/s], below which the arm does not count as moving


def main() -> int:
    """Measure both, print the table, return 0 if the goals are met."""
    args = parse_options(__doc__, motions=100, seed=0)
    rng = np.random.default_rng(args.seed)
    simulation = Simulation(UR5Config())
    simulation.reset(np.zeros(1, np.intp), [TableScene("empty", (), simulation.body.arm.home)], [0])
    report = Report(f"{args.motions} motions each, seed {args.seed}")
    for what, found, unit, goal in (
        (f"distance from a straight line at {SPEED} m/s", lines(simulation, rng, args.motions), "m", PATH_GOAL_M),
        ("settling after a joint goal at full speed", settle(simulation, rng, args.motions), "s", SETTLE_GOAL_S),
    ):
        value = f"median {np.median(found):.6f} {unit}, worst {found.max():.6f} {unit}"
        report.add(what, value, f"worst at most {goal} {unit}", met=found.max() <= goal)
    return report.end(args.json)


def follow(simulation: Simulation, goal: BrainCommand) -> tuple[ResultCode, NDArray, NDArray]:
    """Follow a goal; return how it ended, and the joints as measured and as commanded at every tick.

    Measured are positions and speeds, shape (ticks, 12); commanded are positions, shape (ticks, 6).
    """
    bridge, measured, commanded = simulation.bridge, [], []
    refusal = bridge.submit(goal)
    if refusal is not None:
        return refusal.code, np.zeros((0, 12)), np.zeros((0, 6))
    while True:
        bridge.advance_ticks(1)
        measured.append(reading(simulation))
        commanded.append(bridge.state().command[0, :6])
        for result in bridge.take_results():
            return result.code, np.array(measured), np.array(commanded)


def reading(simulation: Simulation) -> NDArray[np.float64]:
    """Return the positions and speeds of the six joints now."""
    state = simulation.bridge.state()
    return np.concatenate([state.joint_positions[0, :6], state.joint_velocities[0, :6]])


def lines(simulation: Simulation, rng: np.random.Generator, motions: int) -> NDArray[np.float64]:
    """Return the largest distance from the line of each motion [m]."""
    kinematics = simulation.kinematics
    worst: list[float] = []
    tries = 0
    while len(worst) < motions:
        tries += 1
        start = kinematics.tool(simulation.cerebellum.command[0, :6])
        x, y, z = rng.uniform(*_BOX).tolist()
        # The tool points down, and turns about its own axis on the way.
        turn = rng.uniform(-0.5, 0.5)
        c, s = np.cos(turn), np.sin(turn)
        matrix = start.copy()
        matrix[:3, :3] = start[:3, :3] @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        matrix[:3, 3] = x, y, z
        values = pose_vectors(matrix).tolist()
        goal = BrainCommand(
            f"line-{tries}",
            target_pose=Pose((x, y, z), (values[3], values[4], values[5], values[6])),
            motion="line",
            max_velocity=SPEED,
        )
        code, measured, _ = follow(simulation, goal)
        if code != ResultCode.SUCCEEDED:
            continue  # some lines pass the base or a singular posture and are refused
        along = matrix[:3, 3] - start[:3, 3]
        along /= np.sqrt((along * along).sum())
        way = kinematics.tool(measured[:, :6])[:, :3, 3] - start[:3, 3]
        across = way - (way @ along)[:, None] * along
        worst.append(float(np.sqrt((across * across).sum(axis=1)).max()))
    return np.array(worst)


def settle(simulation: Simulation, rng: np.random.Generator, motions: int) -> NDArray[np.float64]:
    """Return the settling time after each joint goal [s]."""
    times: list[float] = []
    home = np.array(simulation.body.arm.home[:6])
    tries = 0
    while len(times) < motions:
        tries += 1
        target = home + rng.uniform(-0.8, 0.8, 6)
        goal = BrainCommand(f"joint-{tries}", joint_target=tuple(target.tolist()))
        code, measured, commanded = follow(simulation, goal)
        if code != ResultCode.SUCCEEDED:
            continue  # some targets lie in the table
        # The goal's result may come before the arm is still: watch it a while longer.
        bridge = simulation.bridge
        for _ in range(simulation.rates.control_hz // 2):
            bridge.advance_ticks(1)
            measured = np.concatenate([measured, reading(simulation)[None]])
        end = int((np.abs(commanded - target).max(axis=1) > 1e-9).sum())
        away = np.abs(measured[:, :6] - target).max(axis=1) > _TOLERANCE
        moving = np.abs(measured[:, 6:]).max(axis=1) > _STILL
        times.append(max(0, int(np.flatnonzero(away | moving)[-1]) + 1 - end) / simulation.rates.control_hz)
    return np.array(times)


if __name__ == "__main__":
    sys.exit(main())
