"""Whether a goal that is being followed is on its way, has arrived or has failed."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bhd_lerobot.bodies.body import Arm
from bhd_lerobot.control.commands import BrainCommand, ResultCode
from bhd_lerobot.control.kernels import kernel

Array = NDArray[np.float64]

JOINT_TOLERANCE = 0.002  # [rad] a joint this close to its target has arrived,
JOINT_STILL = 0.01  # [rad/s] if it is also slower than this: it does not move
SETTLING_S = 0.5  # [s] after its trajectory's end that the arm may take to arrive
OPENING_TOLERANCE = 0.002  # [m] a gripper this close to its target has arrived
GRIPPER_STILL = 0.002  # [m/s] a gripper that is slower than this
GRIPPER_STALL_S = 0.1  # [s] for so long, though it is not to be at rest where it is, holds something
GRIPPING_S = 1.5  # [s] after its trajectory's end that a gripper may take to arrive or to hold something


@dataclass(frozen=True)
class Verdict:
    """The outcome of the goal of one simulation.

    Attributes:
        message: as text, with the offending value and the limit.
    """

    sim: int
    code: ResultCode
    message: str


class FollowingLimit:
    """How far joints that follow their references may be from them, with servos that get their commands late.

    A joint with a latency is where its reference was so long ago: behind by what the present speed, and a change of it
    at the largest acceleration, make of that time.
    """

    def __init__(self, arm: Arm, n: int) -> None:
        self._arm, self._n = arm, n
        self._acceleration = np.asarray(arm.limits.acceleration[: len(arm.chain.joints)])
        self.latency_s = np.zeros(n)
        self.set_latency(np.arange(n), 0.0)

    def set_latency(self, ids: NDArray[np.intp], latency_s: ArrayLike) -> None:
        """Set by how much the servos of some simulations are late, beyond the body's latency [s]."""
        self.latency_s[ids] = np.asarray(latency_s) + self._arm.latency_s
        self.at_rest = self._arm.blocked_rad + self._acceleration * self.latency_s[:, None] ** 2 / 2

    def of(self, velocity: Array) -> Array:
        """Return the largest distances [rad], shape (n, dof), from references of these speeds, shape (n, dof)."""
        late = self.latency_s.any()  # 0 times infinity is no number
        return self.at_rest + np.abs(velocity) * self.latency_s[:, None] if late else self.at_rest


@kernel("b1(f8[:,::1], f8[:,::1], b1[:,::1], i8[::1], f8[:,::1], f8[::1], f8[:,::1], f8[:,::1], f8[:,:], f8[:,:])")
def follow_references(  # noqa: PLR0917
    away: Array,
    most: Array,
    off: NDArray[np.bool_],
    still: NDArray[np.int64],
    at_rest: Array,
    latency_s: Array,
    reference: Array,
    speed: Array,
    position: Array,
    velocity: Array,
) -> bool:
    """Compare joints with their references, and count for how long grippers stand still; return if any joint is off."""
    any_off = False
    for sim in range(len(off)):
        for k in range(off.shape[1]):
            away[sim, k] = abs(position[sim, k] - reference[sim, k])
            most[sim, k] = at_rest[sim, k]
            if latency_s[sim] != 0.0:  # 0 times infinity is no number
                most[sim, k] += abs(speed[sim, k]) * latency_s[sim]
            off[sim, k] = away[sim, k] > most[sim, k]
            any_off |= off[sim, k]
        stands = abs(velocity[sim, -1]) < GRIPPER_STILL and speed[sim, -1] == 0.0
        still[sim] = still[sim] + 1 if stands else 0
    return any_off


class Supervisor:
    """Judges goals of n simulations by what is measured, once a tick.

    Args:
        control_hz: ticks a second [Hz].
    """

    def __init__(self, arm: Arm, n: int, control_hz: int) -> None:
        self._joints, self._dof = arm.chain.joints, len(arm.chain.joints)
        self.limit = FollowingLimit(arm, n)
        self._most_off = np.zeros((n, self._dof))
        self._stall_ticks = round(GRIPPER_STALL_S * control_hz)
        self._settling_ticks = round(SETTLING_S * control_hz)
        self._gripping_ticks = round(GRIPPING_S * control_hz)
        self._hz = control_hz
        self._target = np.zeros((n, self._dof + 1))
        self._moves_arm, self._moves_gripper = np.zeros(n, np.bool_), np.zeros(n, np.bool_)
        self._tick = 0
        self._begun, self._deadline = np.zeros(n, np.int64), np.zeros(n, np.int64)  # ticks
        self._next_deadline = 0  # no goal that is followed has an earlier one
        self._since_end, self._still = np.zeros(n, np.int64), np.zeros(n, np.int64)
        self._away = np.zeros((n, self._dof))  # how far each joint is from its reference [rad]
        self._off = np.zeros((n, self._dof), np.bool_)
        self._follow = follow_references.bind(self._away, self._most_off, self._off, self._still)

    def begin(self, sim: int, command: BrainCommand, target: Array) -> None:
        """Forget the last goal; judge a new one, whose trajectory ends at a target of shape (dof + 1,)."""
        self._target[sim] = target
        self._moves_arm[sim] = command.target_pose is not None or command.joint_target is not None
        self._moves_gripper[sim] = command.gripper is not None
        self._begun[sim] = self._tick
        self._deadline[sim] = self._tick + math.ceil(command.timeout_s * self._hz - 1e-6)
        self._next_deadline = min(self._next_deadline, int(self._deadline[sim]))
        self._since_end[sim] = self._still[sim] = 0
        self._away[sim] = 0.0

    def error(self, sim: int) -> float:
        """Return the largest distance of a joint from its reference at the last tick [rad]."""
        return float(self._away[sim].max())

    def judge(
        self,
        ids: NDArray[np.intp],
        playing: NDArray[np.bool_],
        reference: tuple[Array, Array],
        measured: tuple[Array, Array],
    ) -> list[Verdict]:
        """Return the goals that end now.

        Args:
            playing: whose trajectory has not ended yet, shape (n,).
            reference: what the plant was last commanded: positions and velocities, each of shape (n, dof + 1).
            measured: what it did: positions and velocities, each of shape (n, dof + 1).
        """
        self._tick += 1
        any_off = self._follow(self.limit.at_rest, self.limit.latency_s, *reference, *measured)
        on_time = self._tick < self._next_deadline
        if on_time and np.count_nonzero(playing[ids]) == len(ids) and not any_off:
            return []
        due = ids if not on_time else ids[~playing[ids] | self._off[ids].any(axis=1)]
        verdicts = [self._judge(int(sim), bool(playing[sim]), measured) for sim in due]
        if not on_time:
            self._next_deadline = int(self._deadline[ids].min())
        return [verdict for verdict in verdicts if verdict is not None]

    def _judge(self, sim: int, playing: bool, measured: tuple[Array, Array]) -> Verdict | None:
        position, velocity = measured[0][sim], measured[1][sim]
        if self._off[sim].any():
            away, most = self._away[sim], self._most_off[sim]
            joint = int((away - most).argmax())
            return Verdict(
                sim,
                ResultCode.PATH_TOLERANCE,
                f"{self._joints[joint]} is {away[joint]:.3f} rad from its reference; {most[joint]:.3g} rad is the "
                "most: something is in its way, or it carries too much.",
            )
        verdict = None if playing else self._judge_end(sim, position, velocity)
        if verdict is None and self._tick >= self._deadline[sim]:
            seconds = (self._deadline[sim] - self._begun[sim]) / self._hz
            return Verdict(sim, ResultCode.TIMEOUT, f"The goal was not reached within its {seconds:.3g} s.")
        return verdict

    def _judge_end(self, sim: int, position: Array, velocity: Array) -> Verdict | None:
        dof = self._dof
        self._since_end[sim] += 1
        off, speed = np.abs(position - self._target[sim]), np.abs(velocity)
        away = np.maximum(off[:dof] / JOINT_TOLERANCE, speed[:dof] / JOINT_STILL)
        arm_away = self._moves_arm[sim] and away.max() > 1.0
        stalled = self._still[sim] >= self._stall_ticks
        gripper_away = self._moves_gripper[sim] and off[dof] > OPENING_TOLERANCE and not stalled
        if not arm_away and not gripper_away:
            return Verdict(sim, ResultCode.SUCCEEDED, self._arrival(sim, float(position[dof])))
        if arm_away and self._since_end[sim] > self._settling_ticks:
            joint = int(away.argmax())
            return Verdict(
                sim,
                ResultCode.GOAL_TOLERANCE,
                f"{self._joints[joint]} is {off[joint]:.4f} rad from its target at {speed[joint]:.3f} rad/s, "
                f"{SETTLING_S} s after the end of the motion; "
                f"{JOINT_TOLERANCE} rad and {JOINT_STILL} rad/s are the most.",
            )
        if gripper_away and self._since_end[sim] > self._gripping_ticks:
            return Verdict(
                sim,
                ResultCode.GOAL_TOLERANCE,
                f"The gripper has neither reached {self._target[sim, dof]:.4f} m nor stalled {GRIPPING_S} s after the "
                f"end of the motion; the opening is {position[dof]:.4f} m.",
            )
        return None

    def _arrival(self, sim: int, opening: float) -> str:
        """Return what to say about a goal that was reached."""
        if not self._moves_gripper[sim]:
            return "The target is reached."
        target = float(self._target[sim, self._dof])
        if abs(opening - target) <= OPENING_TOLERANCE:
            return f"The target is reached; the opening is {opening:.4f} m."
        return f"The gripper has stalled on its way to {target:.4f} m; the opening is {opening:.4f} m."
