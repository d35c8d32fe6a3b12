"""A goal manager, the reference that it writes, and an arm that follows it, watched for every limit at every tick."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from bhd_lerobot.bodies.ur import ur5
from bhd_lerobot.control.arm.controller import ArmController
from bhd_lerobot.control.commands import BrainCommand, CommandResult, GoalPhase, Pose, ResultCode
from bhd_lerobot.control.geometry.kinematics import ArmKinematics
from bhd_lerobot.control.kernels import as_objects
from bhd_lerobot.control.motion.planning import Planning
from bhd_lerobot.control.motion.player import play
from bhd_lerobot.control.motion.supervision import has_goals_to_serve
from bhd_lerobot.control.motion.trajectory import MotionLimits

Array = NDArray[np.float64]

HZ = 500
ARM = ur5()
HOME = np.array(ARM.arm.home)
KINEMATICS = ArmKinematics(ARM.arm.chain, ARM.limits)
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
    return tuple(float(v) for v in HOME[:6] + np.array([*changes, *(0.0,) * (6 - len(changes))]))


def broken_limit(rows: Array, hard: NDArray[np.bool_]) -> str:
    """Return which limit a reference breaks, or an empty text.

    Args:
        rows: position, velocity and acceleration at each tick, shape (T, 3, n, 7).
        hard: whether an arm was stopping hard in the tick that led to each row but the first, shape (T - 1, n).
    """
    if not np.isfinite(rows).all():
        return "finite"
    (p0, v0, a0), (p, v, a) = np.moveaxis(rows[:-1], 1, 0), np.moveaxis(rows[1:], 1, 0)
    acceleration = np.where(hard[..., None], STOP_LIMITS.acceleration, LIMITS.acceleration)
    jerk = np.where(hard[..., None], STOP_LIMITS.jerk, LIMITS.jerk) / HZ
    checks = {
        "upper": p - LIMITS.upper,
        "lower": LIMITS.lower - p,
        "velocity": np.abs(v) - LIMITS.velocity,
        "acceleration": np.abs(a) - acceleration,
        "jerk": np.abs(a - a0) - jerk,
        "continuity": np.abs(p - p0) - LIMITS.velocity / HZ,
        "velocity is the position's change": np.abs(p - p0 - (v0 + v) / 2 / HZ) - jerk / HZ**2,
        "acceleration is the velocity's change": np.abs(v - v0 - (a0 + a) / 2 / HZ) - jerk / HZ,
    }
    for name, excess in checks.items():
        if (excess > SLACK).any():
            tick, sim, dim = np.argwhere(excess > SLACK)[0]
            return f"{name}: dimension {dim} of arm {sim} at tick {tick}, by {excess.max():.3g}"
    return ""


class Rig:
    """Goals of n arms on a clock of ticks."""

    def __init__(self, n: int = 1, planning: Planning | None = None) -> None:
        self.n = n
        controller = ArmController(ARM, n, HZ, 20, planning)
        self.manager, states = controller.goals, controller.states
        self.position, self.velocity, self.acceleration = (
            controller.command,
            controller.velocity,
            controller.acceleration,
        )
        self.measured_position, self.measured_velocity = states["position"][:, :7], states["velocity"][:, :7]
        self.measured_position[:] = HOME
        [self._limits] = as_objects(controller.arm_limits)
        self._records = list(zip(as_objects(states), as_objects(controller.arms), strict=True))
        self.hard = np.zeros(n, np.bool_)
        self.disturb: Callable[[Rig], None] | None = None  # changes what is measured
        self._rows, self._stopped = [np.stack(self.reference)], list[NDArray[np.bool_]]()

    @property
    def reference(self) -> tuple[Array, Array, Array]:
        return self.position, self.velocity, self.acceleration

    def tick(self, ticks: int = 1) -> None:
        for _ in range(ticks):
            for sim, (state, arm) in enumerate(self._records):
                if has_goals_to_serve(state, arm, self._limits):
                    self.manager.serve(sim)
                play(state, arm, self._limits, self.manager.player.rows)
            self._stopped.append(self.hard.copy())
            if self.hard.any():
                self.hard &= self.velocity.any(axis=1) | self.acceleration.any(axis=1)
            self.measured_position[:], self.measured_velocity[:] = self.position, self.velocity
            if self.disturb is not None:
                self.disturb(self)
            self._rows.append(np.stack(self.reference))

    def run(self, most: int = 30_000) -> int:
        """Tick until nothing is to be done; return the ticks it took."""
        for tick in range(most):
            if not self.manager.busy.any():
                self.check()
                return tick
            self.tick()
        raise AssertionError("still busy")

    def check(self) -> None:
        if self._stopped:
            assert broken_limit(np.array(self._rows), np.array(self._stopped)) == ""

    def bring_to_rest(self) -> None:
        """Bring the arms to rest by other means, which no limit is held against."""
        self.velocity[:] = self.acceleration[:] = 0.0
        self._rows, self._stopped = [np.stack(self.reference)], []

    @property
    def history(self) -> Array:
        """Position, velocity and acceleration at each tick, shape (T, 3, n, 7)."""
        return np.array(self._rows)

    def go(
        self, task_id: str, sim: int = 0, blocked: ResultCode | None = None, **fields: object
    ) -> CommandResult | None:
        return self.manager.submit(sim, BrainCommand(task_id, **fields), blocked)  # type: ignore[arg-type]

    def stop(self, code: ResultCode, hard: bool, mask: NDArray[np.bool_] | None = None) -> None:
        mask = np.ones(self.n, np.bool_) if mask is None else mask
        for sim in np.flatnonzero(mask):
            self.manager.stop(int(sim), code, hard=hard)
        self.hard |= mask & hard

    def results(self, sim: int = 0) -> list[tuple[str, ResultCode]]:
        return [(result.task_id, result.code) for result in self.manager.take_results(sim)]

    @property
    def phase(self) -> GoalPhase:
        return GoalPhase(int(self.manager.phase[0]))
