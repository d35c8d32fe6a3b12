"""What impedance control does and costs: `python -m benchmarks.impedance`.

A push on a rigid wall at several speeds of approach, an emergency stop in motion, the contact estimate in free motion
with late motors and with noisy encoders, and the time of a tick. Truth is the simulator's. Exits with 3 if a push
settles more than 1 N beside what was commanded.
"""

import sys
from collections.abc import Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from benchmarks._report import Report, parse_options
from benchmarks._turns import seconds
from bhd_lerobot.bodies.body import Rates, Shape
from bhd_lerobot.bodies.ur import ur5
from bhd_lerobot.control.arm.impedance import ImpedanceController
from bhd_lerobot.control.bridge import LockstepBridge
from bhd_lerobot.control.cerebellum import Cerebellum
from bhd_lerobot.control.geometry.kinematics import ArmKinematics
from bhd_lerobot.control.plant import PlantReading
from bhd_lerobot.sim.plant import SimulatedPlant
from bhd_lerobot.sim.world import World

FORCE = 10.0  # [N]
GOAL_N = 1.0
SPEEDS = (0.01, 0.02, 0.05, 0.1)  # of approach [m/s]
# By how many ticks the motors are late, and how noisy the encoders are [rad/s].
FAULTS = ((0, 0.0), (1, 0.0), (2, 0.0), (5, 0.0), (10, 0.0), (25, 0.0), (0, 1e-4), (0, 1e-3), (0, 5e-3))
_RATES = Rates(500, 500, 25)
_START, _FACE = (0.50, 0.11, 0.35), 0.56  # of the tool and of the wall's face [m]
_WALL = Shape("box", _FACE + 0.05, 0.11, 0.0, 0.05, 0.3, 0.7)


class ImperfectPlant(SimulatedPlant):
    """A plant whose motors are late and whose encoders are noisy.

    Args:
        world: the simulations.
        late: ticks that a command needs to arrive.
        noise: standard deviation of the speeds' noise [rad/s]; the positions' is a fiftieth of it [rad].
    """

    def __init__(self, world: World, late: int, noise: float) -> None:
        super().__init__(world)
        self._late, self._noise, self._random = late, noise, np.random.default_rng(0)
        self._sent: list[NDArray[np.float64]] = []

    def read(self, out: PlantReading) -> None:
        """Read the joints, with noise."""
        super().read(out)
        shape = out.velocity[:, :6].shape
        out.velocity[:, :6] += self._random.normal(0, self._noise, shape)
        out.position[:, :6] += self._random.normal(0, self._noise / 50, shape)

    def write(self, ctrl: NDArray[np.float64]) -> None:
        """Take commands, and pass on those of some ticks ago."""
        self._sent.append(ctrl.copy())
        super().write(self._sent[max(0, len(self._sent) - 1 - self._late)])


class Rig:
    """An arm with a closed gripper that points at a wall, or at nothing."""

    def __init__(self, *, wall: bool = False, late: int = 0, noise: float = 0.0, n: int = 1) -> None:
        arm = ur5(actuation="torque")
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = ((0, 0, 1), (0, 1, 0), (-1, 0, 0)), _START
        self.world = World(arm, n, fixtures=(_WALL,) if wall else (), threads=1)
        kinematics = ArmKinematics(arm.arm.chain, arm.limits)
        self.world.qpos[:, :6] = kinematics.solve(pose, np.array(arm.arm.home[:6])).postures[0]
        self.world.qpos[:, 6:8] = 0.0
        self.world.hold()
        self.controller = ImpedanceController(arm, n, _RATES.control_hz, _RATES.ticks_per_frame)
        self.plant = ImperfectPlant(self.world, late, noise)
        cerebellum = Cerebellum(arm, self.plant, _RATES.control_hz, controller=self.controller)
        self.bridge = LockstepBridge(cerebellum, _RATES, self._advance)
        self._tool = self.world.site("tool").position
        self._force = self.world.sensor("force_fixture_0") if wall else np.zeros((n, 3))
        self.tool: list[NDArray] = []
        self.force: list[float] = []
        self.felt: list[NDArray] = []
        self.bridge.restart(np.arange(n))
        self.target = self.controller.command.copy()

    def _advance(self) -> None:
        self.world.step(1)
        self.tool.append(self._tool[0].copy())
        self.force.append(float(self._force[0, 0]))
        self.felt.append(self.controller.contact_wrench[0].copy())

    def keep(self, seconds: float) -> None:
        """Send the target in every frame."""
        for _ in range(round(seconds * _RATES.fps)):
            self.bridge.send(self.target)
            self.bridge.advance_frame()

    def move(self, offset: tuple[float, float, float], speed: float) -> None:
        """Move the target by an offset [m] at a speed [m/s]."""
        frames = round(float(np.linalg.norm(offset)) / speed * _RATES.fps)
        for _ in range(frames):
            self.target[:, :3] += np.divide(offset, frames)
            self.keep(1 / _RATES.fps)

    def push(self, speed: float) -> None:
        """Approach the wall at a speed [m/s] and push on it for two seconds."""
        while -self.felt[-1][0] < 2.0 if self.felt else True:
            self.target[:, 0] += speed / _RATES.fps
            self.keep(1 / _RATES.fps)
        self.target[:, :7] = self.bridge.state().measured[:, :7]
        self.controller.set_wrench((FORCE, 0, 0, 0, 0, 0))
        self.keep(2.0)


def add_pushes(report: Report, speeds: Sequence[float]) -> None:
    """Add rows of how pushes begin and where they settle, at some speeds of approach."""
    for speed in speeds:
        rig = Rig(wall=True)
        rig.push(speed)
        force, felt = -np.array(rig.force), -np.array(rig.felt)[:, 0]
        onset = int(np.flatnonzero(force)[0])
        late = float(np.flatnonzero(np.abs(force[onset:] - FORCE) > 1.0)[-1]) / _RATES.control_hz
        error = float(np.abs(force[-250:] - FORCE).max())
        what = f"push of {FORCE:g} N, approach at {speed} m/s"
        peaks = f"{force.max():.1f} N, after 20 ms {force[onset + 10 :].max():.1f} N"
        report.add(f"{what}: peak", f"{peaks}; within 1 N after {late:.2f} s")
        value = f"{force[-1]:.2f} N, felt {felt[-1]:.2f} N"
        report.add(f"{what}: settled", value, f"within {GOAL_N:g} N", met=error <= GOAL_N)


def add_stop(report: Report) -> None:
    """Add a row of how far the tool goes after an emergency stop at 0.25 m/s."""
    rig = Rig()
    rig.move((0, -0.2, 0), 0.25)
    pressed = rig.tool[-1]
    rig.bridge.estop()
    rig.bridge.advance_ticks(1000)
    away = np.linalg.norm(np.array(rig.tool[-1000:]) - pressed, axis=1) * 1e3
    report.add("emergency stop at 0.25 m/s", f"{away.max():.1f} mm on at the most, {away[-1]:.1f} mm after 2 s")


def add_false_contacts(report: Report, faults: Sequence[tuple[int, float]]) -> None:
    """Add rows of the largest force that is felt in free motion, with late motors and noisy encoders."""
    for late, noise in faults:
        rig = Rig(late=late, noise=noise)
        rig.move((0, -0.4, 0), 0.25)
        rig.keep(0.3)
        felt = np.linalg.norm(np.array(rig.felt)[:, :3], axis=1).max()
        what = f"felt in free motion at 0.25 m/s, motors late by {late} ticks, noise of {noise:g} rad/s"
        report.add(what, f"{felt:.2f} N")


def add_cost(report: Report, counts: Sequence[int]) -> None:
    """Add rows of the time of a tick of some numbers of arms."""
    for n in counts:
        rig = Rig(n=n)
        rig.keep(0.2)
        times = []
        for _ in range(5):
            times.append((seconds(partial(rig.keep, 1.0)) - seconds(partial(rig.world.step, 500))) / 500)
        report.add(f"a tick of {n} arms, physics not counted", f"{np.median(times) * 1e3:.2f} ms")


def main() -> int:
    """Measure everything, print it, return 0 if the goal is met."""
    options = parse_options(__doc__, quick=(False, "one of each only; not to be quoted"))
    report = Report("Impedance control of the UR5")
    add_pushes(report, SPEEDS[-1:] if options.quick else SPEEDS)
    add_stop(report)
    add_false_contacts(report, FAULTS[-1:] if options.quick else FAULTS)
    add_cost(report, (1,) if options.quick else (1, 8))
    return report.end(options.json)


if __name__ == "__main__":
    sys.exit(main())
