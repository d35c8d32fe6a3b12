"""An arm under the cerebellum, on a virtual clock, with perfect joints that a test can break."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Body
from bhd_lerobot.bodies.ur import ur5
from bhd_lerobot.control.arm.controller import ArmController
from bhd_lerobot.control.cerebellum import Cerebellum
from bhd_lerobot.control.commands import BrainCommand, CommandResult, ResultCode
from bhd_lerobot.control.messages import NANOSECONDS, Mode, Request, SendResult, Setpoint
from bhd_lerobot.control.plant import Plant, PlantReading

HZ, FRAME = 500, 20
TICK_NS = NANOSECONDS // HZ
ARM = ur5()
HOME = np.array(ARM.arm.home)
LIMITS = ARM.limits
TIMEOUT_TICKS = round(LIMITS.command_timeout_s * HZ)
LEAD = np.array(ARM.arm.servo_damping) / np.array(ARM.arm.servo_stiffness)
STOP = np.array(LIMITS.stop_deceleration)


class PerfectArm(Plant):
    """Joints without inertia behind servos with stiffness and damping: they lag as the real ones do."""

    home = HOME

    def __init__(self, n: int) -> None:
        self.n = n
        self.position, self.velocity = np.tile(self.home, (n, 1)), np.zeros((n, 7))
        self.fault = np.zeros(n, np.bool_)
        self.lie: dict[int, dict[int, float]] = {}  # simulation -> joint -> what its encoder reads instead
        self.stuck = np.zeros((n, 7), np.bool_)
        self.written: list[np.ndarray] = []

    def read(self, out: PlantReading) -> None:
        out.position[:], out.velocity[:], out.safety[:] = self.position, self.velocity, self.fault
        for sim, lies in self.lie.items():
            for joint, value in lies.items():
                out.position[sim, joint] = value

    def speeds(self, ctrl: np.ndarray) -> np.ndarray:
        """Return how fast joints turn that nothing holds, shape (n, 7)."""
        return (ctrl - self.position) / LEAD

    def write(self, ctrl: np.ndarray) -> None:
        assert np.isfinite(ctrl).all()
        self.written.append(ctrl.copy())
        self.velocity = np.where(self.stuck, 0.0, self.speeds(ctrl))
        self.position = self.position + self.velocity / HZ


class Rig:
    def __init__(self, n: int = 1, active: bool = True, planning: Any = None) -> None:
        self.start(ARM, PerfectArm(n), ArmController(ARM, n, HZ, FRAME, planning), active)

    def start(self, body: Body, plant: Any, controller: Any, active: bool, *, hz: int = HZ, **options: Any) -> None:
        self.n, self.plant, self.controller, self.hz = plant.n, plant, controller, hz
        self.cerebellum = Cerebellum(body, plant, hz, controller, **options)
        self.now, self.sequence, self.names = 0, 0, 0
        self.rows = [self.cerebellum.command.copy()]
        self.modes: list[list[int]] = []
        if active:
            assert self.request(Request.CONFIGURE).accepted.all()
            assert self.request(Request.ACTIVATE).accepted.all()

    def request(self, request: Request, ids: NDArray[np.intp] | None = None) -> SendResult:
        return self.cerebellum.request(request, ids)

    def tick(self, ticks: int = 1) -> None:
        for _ in range(ticks):
            self.cerebellum.tick(self.now)
            self.now += NANOSECONDS // self.hz
            self.rows.append(self.cerebellum.command.copy())
            self.modes.append(self.cerebellum.mode.tolist())

    def check(self) -> None:
        """Assert that the command never jumped, in place or in speed."""
        rows = np.array(self.rows)
        assert np.isfinite(rows).all()
        speed = np.diff(rows, axis=0) * HZ
        assert (np.abs(speed) - LIMITS.velocity).max() <= 1e-6
        # From rest to what the first tick brings, and on. A goal's last tick ends inside a tick: a little more.
        change = np.diff(np.concatenate([np.zeros((1, self.n, 7)), speed]), axis=0) * HZ
        assert (np.abs(change) - 1.01 * STOP).max() <= 1e-3
        assert (rows <= np.array(LIMITS.upper) + 1e-9).all()
        assert (rows >= np.array(LIMITS.lower) - 1e-9).all()

    def send(self, values: np.ndarray, mask: np.ndarray | None = None) -> SendResult:
        self.sequence += 1
        return self.cerebellum.offer(
            Setpoint(self.sequence, self.now, np.broadcast_to(values, self.rows[0].shape)), mask
        )

    def stream(self, values: np.ndarray, frames: int) -> None:
        for _ in range(frames):
            assert self.send(values).accepted.all()
            self.tick(FRAME * self.hz // HZ)

    def go(self, sim: int = 0, **fields: object) -> CommandResult | None:
        self.names += 1
        return self.cerebellum.submit(sim, BrainCommand(str(self.names), **fields))  # type: ignore[arg-type]

    def results(self, sim: int = 0) -> list[tuple[str, ResultCode]]:
        return [(one.task_id, one.code) for one in self.controller.take_results(sim)]

    def until(self, mode: Mode, most: int = 3000) -> int:
        """Tick until the first robot is in a mode; return how many ticks it took."""
        for ticks in range(most):
            if self.mode == mode:
                return ticks
            self.tick()
        raise AssertionError(f"still {self.mode!r}")

    @property
    def mode(self) -> Mode:
        return Mode(int(self.cerebellum.mode[0]))


def off(**changes: float) -> np.ndarray:
    values = HOME.copy()
    for name, change in changes.items():
        values[int(name[1:])] += change
    return values


def posture(**changes: float) -> tuple[float, ...]:
    return tuple(off(**changes)[:6].tolist())


SWEEP = {"joint_target": posture(j0=0.8), "gripper": 0.03}
