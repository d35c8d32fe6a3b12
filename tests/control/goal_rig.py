"""A goal manager, the reference that it writes, and an arm that follows it, watched for every limit at every tick."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from bhd_lerobot.bodies.ur5 import ur5
from bhd_lerobot.control.commands import BrainCommand, CommandResult, GoalPhase, Pose, ResultCode
from bhd_lerobot.control.goals import GoalManager
from bhd_lerobot.control.kinematics import ArmKinematics
from bhd_lerobot.control.trajectory import MotionLimits

Array = NDArray[np.float64]

HZ = 500
ARM = ur5()
HOME = np.array(ARM.home)
KINEMATICS = ArmKinematics(ARM.chain, ARM.limits)
LIMITS, STOP_LIMITS = MotionLimits.of(ARM.limits), MotionLimits.of(ARM.limits, stop=True)
TOOL = KINEMATICS.tool(HOME[:6])
ZEROS = np.zeros(7)

# What rounding may add: to a position, and so to a speed and an acceleration that come from profiles of other numbers.
SLACK = 1e-6


def pose(matrix: Array) -> Pose:
    x, y, z, w = (float(value) for value in Rotation.from_matrix(matrix[:3, :3]).as_quat())
    px, py, pz = (float(value) for value in matrix[:3, 3])
    return Pose((px, py, pz), (w, x, y, z))


def moved(dx: float = 0.0, dy: float = 0.0, dz: float = 0.0, turn: float = 0.0) -> Pose:
    """Return the home pose, moved in the base frame and turned about the tool's axis."""
    matrix = TOOL.copy()
    matrix[:3, 3] += dx, dy, dz
    matrix[:3, :3] = matrix[:3, :3] @ Rotation.from_euler("z", turn).as_matrix()
    return pose(matrix)


def joints(*changes: float) -> tuple[float, ...]:
    """Return the home posture with its first joints changed."""
    return tuple(float(v) for v in HOME[:6] + np.array([*changes, *(0.0,) * (6 - len(changes))]))


def broken_limits(before: tuple[Array, Array, Array], after: tuple[Array, Array, Array], hard: NDArray[np.bool_]) -> str:
    """Return which limit a step of the reference breaks, or an empty text; all arrays have shape (n, 7)."""
    most_acceleration = np.where(hard[:, None], STOP_LIMITS.acceleration, LIMITS.acceleration)
    most_jerk = np.where(hard[:, None], STOP_LIMITS.jerk, LIMITS.jerk)
    checks = {
        "finite": np.isfinite(after).all(axis=0) - 1.0,
        "upper": after[0] - LIMITS.upper,
        "lower": LIMITS.lower - after[0],
        "velocity": np.abs(after[1]) - LIMITS.velocity,
        "acceleration": np.abs(after[2]) - most_acceleration,
        "jerk": (np.abs(after[2] - before[2]) * HZ - most_jerk) / HZ,
        "continuity": (np.abs(after[0] - before[0]) * HZ - LIMITS.velocity) / HZ,
        "difference of position": np.abs(after[0] - before[0] - (before[1] + after[1]) / 2 / HZ) - most_jerk / HZ**3,
        "difference of velocity": np.abs(after[1] - before[1] - (before[2] + after[2]) / 2 / HZ) - most_jerk / HZ**2,
    }
    for name, excess in checks.items():
        if name == "finite":
            if (excess < 0).any():
                return name
        elif (excess > SLACK).any():
            sim, dim = np.argwhere(excess > SLACK)[0]
            return f"{name} of dimension {dim} of simulation {sim} by {excess[sim, dim]:.3g}"
    return ""


class Rig:
    """Goals of n arms on a clock of ticks."""

    def __init__(self, n: int = 1, **options: int) -> None:
        self.n = n
        self.manager = GoalManager(ARM, n, HZ, KINEMATICS, **options)
        self.position = np.tile(HOME, (n, 1))
        self.velocity, self.acceleration = np.zeros((n, 7)), np.zeros((n, 7))
        self.measured_position, self.measured_velocity = self.position.copy(), self.velocity.copy()
        self.hard = np.zeros(n, np.bool_)
        self.disturb: Callable[[Rig], None] | None = None  # changes what is measured
        self.history: list[Array] = []

    @property
    def reference(self) -> tuple[Array, Array, Array]:
        return self.position, self.velocity, self.acceleration

    def tick(self, ticks: int = 1) -> None:
        for _ in range(ticks):
            before = (self.position.copy(), self.velocity.copy(), self.acceleration.copy())
            self.manager.tick(*self.reference, self.measured_position, self.measured_velocity)
            assert broken_limits(before, self.reference, self.hard) == ""
            self.hard &= self.velocity.any(axis=1) | self.acceleration.any(axis=1)
            self.measured_position[:], self.measured_velocity[:] = self.position, self.velocity
            if self.disturb is not None:
                self.disturb(self)
            self.history.append(self.position.copy())

    def run(self, most: int = 6000) -> int:
        """Tick until nothing is to be done; return the ticks it took."""
        for tick in range(most):
            if not self.manager.busy.any():
                return tick
            self.tick()
        raise AssertionError("still busy")

    def go(self, task_id: str, sim: int = 0, blocked: ResultCode | None = None, **fields: object) -> CommandResult | None:
        return self.manager.submit(sim, BrainCommand(task_id, **fields), blocked)  # type: ignore[arg-type]

    def stop(self, code: ResultCode, hard: bool, mask: NDArray[np.bool_] | None = None) -> None:
        mask = np.ones(self.n, np.bool_) if mask is None else mask
        self.manager.stop(mask, code, hard, *self.reference)
        self.hard |= mask & hard

    def results(self, sim: int = 0) -> list[tuple[str, ResultCode]]:
        return [(result.task_id, result.code) for result in self.manager.take_results(sim)]

    @property
    def phase(self) -> GoalPhase:
        return GoalPhase(int(self.manager.phase[0]))
