"""An arm with torque motors under the cerebellum, beside a wall or in free space, and what happened tick by tick."""

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Rates, Shape
from bhd_lerobot.bodies.ur import ur5
from bhd_lerobot.control.arm.compliance import Compliance
from bhd_lerobot.control.arm.impedance import ImpedanceController
from bhd_lerobot.control.bridge import LockstepBridge
from bhd_lerobot.control.cerebellum import Cerebellum
from bhd_lerobot.control.geometry.kinematics import ArmKinematics
from bhd_lerobot.control.messages import Mode
from bhd_lerobot.sim.plant import SimulatedPlant
from bhd_lerobot.sim.world import World

Array = NDArray[np.float64]

ARM = ur5(actuation="torque")
KINEMATICS = ArmKinematics(ARM.arm.chain, ARM.limits)
RATES = Rates(500, 500, 25)
START = np.array([0.50, 0.11, 0.35])  # of the tool, which points along x
WALL = Shape("box", 0.65, 0.11, 0.0, 0.05, 0.3, 0.7)  # its face is at x = 0.60


def forward_posture(place: Array = START) -> Array:
    """Return the joints' positions [rad] that put the tool at a place, pointing along x."""
    pose = np.eye(4)
    pose[:3, :3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]
    pose[:3, 3] = place
    return KINEMATICS.solve(pose, np.array(ARM.arm.home[:6])).postures[0]


class Rig:
    """One or more arms with closed grippers, configured and active."""

    def __init__(self, *, wall: bool = False, compliance: Compliance | None = None, n: int = 1) -> None:
        self.world = World(ARM, n, fixtures=(WALL,) if wall else (), threads=1)
        self.push: Array = np.zeros(6)  # a wrench about the tool centre point that acts on the arm, base frame
        self._applied = self.world.derived("xfrc_applied")
        self._gripper = self.world.model.body("gripper").id
        self._centre = self.world.derived("xipos")
        self._tool = self.world.site("tool").position
        self._force = self.world.sensor("force_fixture_0") if wall else np.zeros((n, 3))
        self.world.qpos[:, :6] = forward_posture()
        self.world.qpos[:, 6:8] = 0.0
        self.world.hold()
        self.controller = ImpedanceController(ARM, n, 500, RATES.ticks_per_frame)
        if compliance is not None:
            self.controller.set_compliance(compliance)
        self.cerebellum = Cerebellum(ARM, SimulatedPlant(self.world), 500, controller=self.controller)
        self.bridge = LockstepBridge(self.cerebellum, RATES, self._advance)
        self.log: dict[str, list[Array]] = {"force": [], "tool": [], "estimate": [], "torque": [], "command": []}
        self.bridge.restart(np.arange(n))
        self.target = self.controller.command.copy()

    def _advance(self) -> None:
        lever = self._tool - self._centre[:, self._gripper]
        self._applied[:, self._gripper, :3] = self.push[:3]
        self._applied[:, self._gripper, 3:] = self.push[3:] + np.cross(lever, self.push[:3])
        self.world.step(1)
        self.log["force"].append(self._force[0].copy())
        self.log["tool"].append(self._tool[0].copy())
        self.log["estimate"].append(self.controller.contact_wrench[0].copy())
        self.log["torque"].append(self.controller.actuators[0, :6].copy())
        self.log["command"].append(self.controller.command[0].copy())

    def logged(self, name: str, since: int = 0) -> Array:
        """Return what was logged of the first arm from a tick on, shape (ticks, ...)."""
        return np.array(self.log[name][since:])

    @property
    def ticks(self) -> int:
        return len(self.log["tool"])

    @property
    def mode(self) -> Mode:
        return Mode(int(self.cerebellum.mode[0]))

    def wait(self, seconds: float) -> None:
        self.bridge.advance_ticks(round(seconds * 500))

    def keep(self, seconds: float) -> None:
        for _ in range(round(seconds * 25)):
            self.bridge.send(self.target)
            self.bridge.advance_frame()

    def move(self, offset: tuple[float, float, float], speed: float) -> None:
        """Move the target by an offset [m] at a speed [m/s], frame by frame."""
        frames = max(1, round(float(np.linalg.norm(offset)) / speed * 25))
        for _ in range(frames):
            self.target[:, :3] += np.divide(offset, frames)
            self.keep(0.04)

    def approach(self, speed: float, threshold: float = 2.0) -> None:
        """Move along x until something is felt, and make the place of the contact the target."""
        while abs(self.controller.contact_wrench[0, 0]) < threshold:
            self.target[:, 0] += speed / 25
            assert self.target[0, 0] < 0.7
            self.keep(0.04)
        self.target[:] = self.bridge.state().measured
        self.target[:, 7] = 0.0
