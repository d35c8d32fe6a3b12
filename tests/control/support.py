"""A plant with perfect wheels on a virtual clock, and the processes that share memory with a test."""

import mmap
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Drive
from bhd_lerobot.bodies.turtlebot3 import turtlebot3_burger
from bhd_lerobot.control.drive import BaseController
from bhd_lerobot.control.fifo import StateRing
from bhd_lerobot.control.messages import NANOSECONDS, SendResult, Setpoint
from bhd_lerobot.control.plant import Plant, PlantReading
from tests.control import arm_rig

HZ = 200
TICK_NS = NANOSECONDS // HZ
BODY = turtlebot3_burger()


def wheel_speeds(twist: NDArray[np.float64], drive: Drive = BODY.drive) -> NDArray[np.float64]:
    """Return the wheel speeds of twists, shape (n, 2) [rad/s]."""
    straight, turn = twist[:, :1] / drive.wheel_radius, twist[:, 1:] * drive.wheel_separation / 2 / drive.wheel_radius
    return straight + turn * (-1.0, 1.0)


class PerfectPlant(Plant):
    """Wheels that turn as commanded, and that a test can break."""

    def __init__(self, n: int = 1, takes: str = "actuators") -> None:
        self.n, self.takes = n, takes
        self.position = np.zeros((n, 2))
        self.velocity = np.zeros((n, 2))
        self.fault = np.zeros(n, np.bool_)
        self.lie: dict[int, float] = {}  # simulation -> what its encoders read instead
        self.written = np.zeros((n, 2))

    def read(self, out: PlantReading) -> None:
        out.position[:] = self.position
        out.velocity[:] = self.velocity
        out.safety[:] = self.fault
        for sim, value in self.lie.items():
            out.position[sim, 0] = out.velocity[sim, 1] = value

    def write(self, ctrl: NDArray[np.float64]) -> None:
        assert np.isfinite(ctrl).all()
        self.written[:] = ctrl
        if self.takes == "twist":
            self.velocity[:] = wheel_speeds(ctrl)
        else:
            self.velocity[:] = ctrl
        self.position += self.velocity / HZ


class Rig(arm_rig.Rig):
    def __init__(self, n: int = 1, active: bool = True, takes: str = "actuators", **options: object) -> None:
        controller = BaseController(BODY.drive, n, HZ, takes=takes)
        self.start(BODY, PerfectPlant(n, takes), controller, active, hz=HZ, **options)

    def send(  # type: ignore[override]
        self,
        speed: float,
        yaw_rate: float = 0.0,
        *,
        due: int | None = None,
        sequence: int | None = None,
        mask: NDArray[np.bool_] | None = None,
    ) -> SendResult:
        self.sequence = self.sequence + 1 if sequence is None else sequence
        values = np.tile([float(speed), float(yaw_rate)], (self.n, 1))
        return self.cerebellum.offer(Setpoint(self.sequence, self.now if due is None else due, values), mask)

    @property
    def command(self) -> list[float]:
        return [float(value) for value in self.cerebellum.command[0]]

    def refused(self, reason: int) -> int:
        return int(self.cerebellum.refusals[reason, 0])


STATE = np.dtype([("number", np.int64), ("copies", np.int64, (500,))])


def shared_block(path: Path, size: int = 0) -> mmap.mmap:
    """Return memory that processes share through a file: a new zeroed block, or what is there if the size is 0."""
    if size:
        path.write_bytes(bytes(size))
    with path.open("r+b") as file:
        return mmap.mmap(file.fileno(), 0)


def publish(ring: StateRing, number: int) -> None:
    state = np.zeros((), STATE)
    state["number"] = state["copies"] = number
    ring.publish(state)
