"""What an arm does that runs into something: peak force, and time until it presses no more than 20 N.

With position servos, at three speeds, into the table, a box that the arm knows nothing of, and the arm itself. Each is
done by setpoints with the distance check, without it, and without the limit of force as well: then only a joint that is
0.1 rad from its reference stops the arm. Forces are those of the physics, the sum over all contacts, at each tick.

The second table is of a pillar that each link meets while the base joint turns, by the speed of the link where it
strikes, with the limit of force: it is estimated as if it acted on the tool.
"""

import argparse
import sys
from dataclasses import dataclass

import mujoco
import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks._turns import status
from bhd_lerobot.bodies.body import Shape
from bhd_lerobot.bodies.tabletop import TableScene
from bhd_lerobot.control.messages import Mode, Watchdog
from bhd_lerobot.robots.config_ur import UR5Config
from bhd_lerobot.robots.host.simulation import Simulation

LIGHT_N, WITHIN_S = 20.0, 0.5
# Joint speeds as shares of the speed; the gripper's last.
INTO = {
    "table": ((0, 1, 0, 0, 0, 0, 0), ()),
    "box": ((1, 0, 0, 0, 0, 0, 0), (Shape("box", 0.25, 0.45, 0.0, 0.2, 0.1, 0.8),)),
    "itself": ((0, 0, 1, -1, 1, 0, 0), ()),
}
SPEEDS = (0.3, 1.0, 3.0)  # [rad/s]
# What a link alone meets while one joint turns from home: the joint's direction, the lever [m], and the pillar's centre
# and height [m].
PILLARS = {
    "upper arm": ((0, -1, 0, 0, 0, 0, 0), 0.33, (-0.25, 0.14, 0.42)),
    "forearm": ((1, 0, 0, 0, 0, 0, 0), 0.22, (0.06, 0.21, 0.60)),
    "wrist": ((1, 0, 0, 0, 0, 0, 0), 0.42, (0.11, 0.40, 0.60)),
    "palm": ((1, 0, 0, 0, 0, 0, 0), 0.50, (0.13, 0.48, 0.44)),
    "finger": ((1, 0, 0, 0, 0, 0, 0), 0.55, (0.15, 0.53, 0.33)),
}
STRIKES = (0.02, 0.05, 0.1, 0.25)  # [m/s]
WAYS = ("distance check", "no check", "no check, no limit of force")


@dataclass(frozen=True)
class Outcome:
    """What became of one arm.

    Attributes:
        peak: largest force [N].
        over_s: from the first contact until the force stays below 20 N [s]; infinite if it does not.
        ended: what stopped it.
    """

    peak: float
    over_s: float
    ended: str


def run(
    direction: tuple[float, ...], fixtures: tuple[Shape, ...], speed: float, frames: int, way: str = WAYS[1]
) -> Outcome:
    """Move an arm into something by setpoints of a steady speed [rad/s], and wait."""
    force = 150.0 if way != WAYS[2] else float("inf")
    arm = Simulation(UR5Config(max_force=force), 1, threads=1, fixtures=fixtures)
    arm.reset(np.zeros(1, np.intp), [TableScene("empty", (), arm.body.arm.home)], [0])
    if way != WAYS[0]:
        arm.cerebellum.controller.arm_limits["keeps_clear"] = False
    model = arm.world.copy_model(0)
    data, wrench, forces = mujoco.MjData(model), np.zeros(6), []
    after_tick = arm._after_tick

    def measure() -> None:
        after_tick()
        arm.world.copy_into(0, model, data)
        data.ctrl[:] = arm.world.ctrl[0]
        mujoco.mj_forward(model, data)
        total = 0.0
        for contact in range(data.ncon):
            mujoco.mj_contactForce(model, data, contact, wrench)
            total += abs(wrench[0])
        forces.append(total)

    arm._after_tick = measure
    action, limits, watchdog = arm.cerebellum.command.copy(), arm.body.limits, 0
    for _ in range(frames):
        action = np.clip(action + np.array(direction) * speed / arm.rates.fps, limits.lower, limits.upper)
        watchdog |= int(arm.step(action).watchdog[0])
    arm.close()
    heavy = np.flatnonzero(np.array(forces) > LIGHT_N)
    over = 0.0 if not len(heavy) else (heavy[-1] + 1 - heavy[0]) / arm.rates.control_hz
    ended = str(Watchdog(watchdog).name) if watchdog else Mode(int(arm.cerebellum.mode[0])).name
    return Outcome(max(forces), np.inf if len(heavy) and heavy[-1] == len(forces) - 1 else over, ended)


def main() -> int:
    """Print the table; return 3 if an arm touches something in spite of the check, or presses for over 0.5 s."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--speeds", type=float, nargs="+", default=list(SPEEDS), help="of the joints [rad/s]")
    parser.add_argument("--frames", type=int, default=900, help="of each run, at the most")
    arguments = parser.parse_args()
    table = Table(title="A UR5 that runs into something: peak force, and time above 20 N")
    for column in ("into", "speed", *WAYS):
        table.add_column(column)
    missed = False
    for into, (direction, fixtures) in INTO.items():
        for speed in arguments.speeds:
            row = []
            for way in WAYS:
                outcome = run(direction, fixtures, speed, min(arguments.frames, round(60 / speed) + 60), way)
                row.append(f"{outcome.peak:.0f} N, {outcome.over_s:.2f} s, {outcome.ended}")
                # The check knows the table and the arm, not the box.
                missed |= way == WAYS[0] and into != "box" and outcome.peak > 0.0
                missed |= way != WAYS[2] and outcome.over_s > WITHIN_S
            table.add_row(into, f"{speed} rad/s", *row)
    links = Table(title="A link that meets a pillar, with the limit of force: peak force, and time above 20 N")
    for column in ("link", "lever", *(f"{strike} m/s" for strike in STRIKES)):
        links.add_column(column)
    for link, (turn, lever, (x, y, height)) in PILLARS.items():
        pillar, row = Shape("cylinder", x, y, 0.0, 0.03, 0.03, height), []
        for strike in STRIKES:
            outcome = run(turn, (pillar,), strike / lever, min(arguments.frames, round(25 * lever / strike) + 60))
            row.append(f"{outcome.peak:.0f} N, {outcome.over_s:.2f} s, {outcome.ended}")
            missed |= outcome.over_s == np.inf  # slow ones press for long before they press hard
        links.add_row(link, f"{lever} m", *row)
    for one in (table, links):
        Console(width=140).print(one)
    return status(met=not missed)


if __name__ == "__main__":
    sys.exit(main())
