"""An arm on a base under the cerebellum, on a virtual clock, with perfect joints and wheels that a test can break."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.turtlebot3_manipulation import turtlebot3_manipulation
from bhd_lerobot.control.arm.controller import ArmController
from bhd_lerobot.control.arm.mobile import MobileArmController
from bhd_lerobot.control.drive import BaseController
from bhd_lerobot.control.plant import PlantReading
from tests.control import arm_rig
from tests.control.arm_rig import FRAME, HZ

Array = NDArray[np.float64]

BODY = turtlebot3_manipulation()
ARM, WHEELS = slice(0, 5), slice(5, 7)  # of commands, joints and actuators
HOME = np.array([*BODY.arm.home, 0.0, 0.0])  # type: ignore[union-attr]
LEAD = np.array(BODY.arm.servo_damping) / np.array(BODY.arm.servo_stiffness)  # type: ignore[union-attr]
DRIVE: Any = BODY.drive
TIMEOUT_TICKS = round(BODY.limits.command_timeout_s * HZ)
_SPEED, _STOP = (np.array(values[:5]) for values in (BODY.limits.velocity, BODY.limits.stop_deceleration))
_WHEEL_STOP = (DRIVE.limits.stop_deceleration[0], DRIVE.limits.stop_deceleration[1] * DRIVE.wheel_separation / 2)
# What may be written, from the body's numbers.
_BEYOND = _STOP * LEAD**2 / 2 + 1e-6
LOWER = np.array([*(np.array(BODY.limits.lower[:5]) - _BEYOND), *[-DRIVE.max_wheel_speed] * 2])
UPPER = np.array([*(np.array(BODY.limits.upper[:5]) + _BEYOND), *[DRIVE.max_wheel_speed] * 2])
CHANGE = np.array([*((_SPEED + 2 * LEAD * _STOP) / HZ), *[sum(_WHEEL_STOP) / DRIVE.wheel_radius / HZ] * 2])
BEND = np.array([*(_STOP / HZ * (1 / HZ + 2 * LEAD)), np.inf, np.inf])


class PerfectMobileArm(arm_rig.PerfectArm):
    """Joints as an arm's, and wheels that turn as commanded; it judges what is written."""

    home = HOME

    def __init__(self, n: int) -> None:
        super().__init__(n)
        self.anew = np.ones(n, np.bool_)  # robots that the next command need not be near to the last of
        self.last, self.rate, self.read_last = self.position.copy(), np.zeros((n, 7)), self.position.copy()

    def read(self, out: PlantReading) -> None:
        super().read(out)
        self.read_last = out.position.copy()

    def speeds(self, ctrl: Array) -> Array:
        return np.concatenate([(ctrl[:, ARM] - self.position[:, ARM]) / LEAD, ctrl[:, WHEELS]], axis=1)

    def write(self, ctrl: Array) -> None:
        assert (ctrl >= LOWER - 1e-9).all(), ctrl
        assert (ctrl <= UPPER * (1 + 1e-6) + 1e-9).all(), ctrl
        rate = ctrl - self.last
        old = ~self.anew
        assert (np.abs(rate[old]) <= CHANGE * 1.021).all(), rate / CHANGE
        nearer = rate * (self.read_last - ctrl) >= 0.0
        assert ((np.abs(rate - self.rate) <= BEND * 1.021) | nearer | self.anew[:, None]).all(), rate - self.rate
        self.last, self.rate = ctrl.copy(), np.where(self.anew[:, None], 0.0, rate)
        self.anew[:] = False
        super().write(ctrl)


class Rig(arm_rig.Rig):
    def __init__(self, n: int = 1, active: bool = True, plant: Any = None, **drive: Any) -> None:
        arm = ArmController(BODY, n, HZ, FRAME)
        controller = MobileArmController(arm, BaseController(DRIVE, n, HZ, arm=arm, **drive))
        sensors = 0 if drive.get("gyro") is None else drive["gyro"] + 1
        self.start(BODY, PerfectMobileArm(n) if plant is None else plant, controller, active, sensors=sensors)

    def push(self, values: Array, due: int | None = None) -> None:
        """Send what no sender of ours sends."""
        self.sequence += 1
        rows = np.broadcast_to(np.asarray(values, np.float64), (self.n, 7))
        self.cerebellum.fifo.push(self.sequence, self.now if due is None else due, rows, np.ones(self.n, np.bool_))

    @property
    def twist(self) -> list[float]:
        """The first robot's applied twist."""
        return [float(value) for value in self.cerebellum.command[0, WHEELS]]


def off(speed: float = 0.0, yaw_rate: float = 0.0, **changes: float) -> Array:
    """Return a setpoint at home but for some joints (``j0=0.1``), with a twist."""
    values = HOME.copy()
    for name, change in changes.items():
        values[int(name[1:])] += change
    values[WHEELS] = speed, yaw_rate
    return values


def posture(**changes: float) -> tuple[float, ...]:
    return tuple(off(**changes)[:4].tolist())


SWEEP = {"joint_target": posture(j0=0.8), "gripper": 0.01}
