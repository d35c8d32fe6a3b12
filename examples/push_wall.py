"""Push on a wall with a force: approach, feel the contact, push.

Run it from the repository's root with `python examples/push_wall.py --force 10`. The arm takes torques; its controller
makes the tool a damped spring towards a commanded pose and adds the wanted force once it feels the wall.
"""

import argparse

import numpy as np

from bhd_lerobot.bodies.body import Rates, Shape
from bhd_lerobot.bodies.ur import ur5
from bhd_lerobot.control.arm.impedance import ImpedanceController
from bhd_lerobot.control.bridge import LockstepBridge
from bhd_lerobot.control.cerebellum import Cerebellum
from bhd_lerobot.control.commands import ResultCode
from bhd_lerobot.control.geometry.kinematics import ArmKinematics
from bhd_lerobot.sim.plant import SimulatedPlant
from bhd_lerobot.sim.world import World

RATES = Rates(physics_hz=500, control_hz=500, fps=25)
START = (0.50, 0.11, 0.35)  # [m] of the tool
FORWARD = ((0, 0, 1), (0, 1, 0), (-1, 0, 0))  # the tool points along x
WALL = Shape("box", x=0.62, y=0.11, yaw=0.0, size_x=0.05, size_y=0.3, height=0.7)  # its face is at x = 0.57
FELT = 2.0  # [N] an estimate above this is a contact


class PushWall:
    """An arm before a wall, with a closed gripper that points at it.

    Attributes:
        true: force along x on the arm, of the physics, in every tick [N].
    """

    def __init__(self) -> None:
        arm = ur5(actuation="torque")
        self.world = World(arm, fixtures=(WALL,))
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = FORWARD, START
        found = ArmKinematics(arm.arm.chain, arm.limits).solve(pose, np.array(arm.arm.home[:-1]))
        if found.code != ResultCode.SUCCEEDED:
            raise SystemExit(found.message)
        self.world.qpos[:, :6], self.world.qpos[:, 6:8] = found.postures[0], 0.0
        self.world.hold()
        self.controller = ImpedanceController(arm, 1, RATES.control_hz, RATES.ticks_per_frame)
        cerebellum = Cerebellum(arm, SimulatedPlant(self.world), RATES.control_hz, controller=self.controller)
        self.bridge = LockstepBridge(cerebellum, RATES, self._advance)
        self.bridge.restart(np.arange(1))
        self._sensor = self.world.sensor("force_fixture_0")
        self.true: list[float] = []
        self.target = self.controller.command.copy()

    @property
    def now(self) -> float:
        """Seconds since the start [s]."""
        return len(self.true) / RATES.control_hz

    @property
    def felt(self) -> float:
        """The estimated force along x on the tool [N]."""
        return float(self.controller.contact_wrench[0, 0])

    def frame(self) -> None:
        """Send the target and let one frame go by."""
        self.bridge.send(self.target)
        self.bridge.advance_frame()

    def approach(self, speed: float) -> None:
        """Move along x at a speed [m/s] until something is felt, and stay there."""
        while -self.felt < FELT:
            if self.target[0, 0] > START[0] + 0.2:
                raise SystemExit("There is no wall.")
            self.target[0, 0] += speed / RATES.fps
            self.frame()
        self.target[:, :7] = self.bridge.state().measured[:, :7]

    def report(self, what: str) -> None:
        """Print where the tool is and what it feels."""
        x = float(self.bridge.state().measured[0, 0])
        print(
            f"{self.now:6.2f} s  {what:<9}  tool x {x:.4f} m  force {-self.true[-1]:7.2f} N  felt {-self.felt:7.2f} N"
        )

    def _advance(self) -> None:
        self.world.step(1)
        self.true.append(float(self._sensor[0, 0]))


def main() -> None:
    """Run the example."""
    parser = argparse.ArgumentParser(description="Push on a wall with a force.")
    parser.add_argument("--force", type=float, default=10.0, help="force to push with [N], up to 60")
    parser.add_argument("--speed", type=float, default=0.02, help="speed of the approach [m/s], up to 0.1")
    parser.add_argument("--hold", type=float, default=2.0, help="how long to push [s], at least 0.5")
    options = parser.parse_args()
    for name, value, least, most in (
        ("--force", options.force, 0.0, 60.0),
        ("--speed", options.speed, 0.001, 0.1),
        ("--hold", options.hold, 0.5, 60.0),
    ):
        if not least <= value <= most:
            parser.error(f"{name} is {value:g}; it must be between {least:g} and {most:g}.")

    push = PushWall()
    push.bridge.advance_frame()
    push.report("approach")
    push.approach(options.speed)
    push.report("contact")
    push.controller.set_wrench((options.force, 0, 0, 0, 0, 0))
    for number in range(round(options.hold * RATES.fps)):
        push.frame()
        if number % 5 == 4:
            push.report("push")
    settled = -np.array(push.true[-RATES.control_hz // 4 :])

    push.controller.set_wrench(np.zeros(6))
    push.target[0, 0] -= 0.03
    for _ in range(RATES.fps):
        push.frame()
    push.report("released")
    print(f"peak at the contact {-min(push.true):.2f} N")
    error = np.abs(settled - options.force).max()
    print(f"settled at {settled.mean():.2f} N, within {error:.2f} N of {options.force:g} N")


if __name__ == "__main__":
    main()
