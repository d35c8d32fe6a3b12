"""What grippers hold, as far as it can be known without eyes: something that stood on the table when they closed."""

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import HELD, Arm, Capsule
from bhd_lerobot.control.geometry.forward_kinematics import ForwardKinematics
from bhd_lerobot.control.kernels import kernel
from bhd_lerobot.control.motion.supervision import GRIPPER_STALL_S, GRIPPER_STILL
from bhd_lerobot.control.plant import PlantReading

Array = NDArray[np.float64]

_INSIDE = 0.005  # [m] a gripper that stalls so far from where it is commanded to holds something
_HIGHEST = 0.2  # [m] what is taken with the tool higher than this above the table did not stand on it
_SLACK = 0.0002  # [m] by which it may come nearer to the table than when it was taken: it can be put back


@kernel("b1(i8[::1], f8[:,::1], b1[::1], i8, f8[:,:], f8[:,:], f8[:,:])")
def follow_grippers(  # noqa: PLR0917
    ticks: NDArray[np.int64],
    where: Array,
    changed: NDArray[np.bool_],
    stall_ticks: int,
    command: Array,
    position: Array,
    velocity: Array,
) -> bool:
    """Count for how long closing grippers have stood still; return whether any holds or loses something now."""
    any_changed = False
    for sim in range(len(where)):
        holds = ticks[sim] >= stall_ticks
        # What is held may move the fingers: it is lost when they get to where they are commanded to.
        stays = position[sim, -1] - command[sim, -1] > _INSIDE and (holds or abs(velocity[sim, -1]) < GRIPPER_STILL)
        if stays and ticks[sim] == 0:
            for k in range(where.shape[1]):
                where[sim, k] = command[sim, k]
        ticks[sim] = ticks[sim] + 1 if stays else 0
        changed[sim] = (ticks[sim] >= stall_ticks) != holds
        any_changed |= changed[sim]
    return any_changed


class HeldObjects:
    """Finds out what the grippers of n arms hold.

    A gripper holds something if it stands still though it is commanded to close further, for as long as a goal of the
    gripper takes for that. What it holds is taken to reach as far down as the table was when the fingers stopped, and
    to be as thick as they were apart. It is forgotten when the gripper opens, or closes without it.

    Args:
        control_hz: ticks a second [Hz].
    """

    def __init__(self, arm: Arm, n: int, control_hz: int) -> None:
        self._chain, self._forward = arm.chain, ForwardKinematics(arm.chain)
        self._dof = len(arm.chain.joints)
        self._ticks: NDArray[np.int64] = np.zeros(n, np.int64)  # for which each gripper has stood still
        self._where = np.zeros((n, self._dof))  # the arm's posture when that began [rad]
        self._changed = np.zeros(n, np.bool_)
        stall_ticks = round(GRIPPER_STALL_S * control_hz)
        self._follow = follow_grippers.bind(self._ticks, self._where, self._changed, stall_ticks)

    def update(self, reading: PlantReading, command: Array) -> list[tuple[int, Capsule | None]]:
        """Take one tick into account; return the arms that hold something from now on, or nothing any more.

        Args:
            command: the reference, shape (n, dof + 1).
        """
        if not self._follow(command, reading.position, reading.velocity):
            return []
        changed = np.flatnonzero(self._changed).tolist()
        return [(sim, self._capsule(sim, reading) if self._ticks[sim] else None) for sim in changed]

    def _capsule(self, sim: int, reading: PlantReading) -> Capsule | None:
        """Return what one gripper holds; None if it did not stand on the table."""
        chain, tool = self._chain, self._forward.tool(self._where[sim])
        below = float(tool[2, 3]) - chain.min_distance - _SLACK
        if not 0.0 < below < _HIGHEST:
            return None
        radius = min(float(reading.position[sim, -1]) / 2, 0.9 * below)  # a capsule with a direction
        x, y, z = chain.tool - tool[2, :3] * (below - radius)  # the third row is the vertical in the tool's frame
        return Capsule(HELD, self._dof, chain.tool, (float(x), float(y), float(z)), radius)

    def restart(self, ids: NDArray[np.intp]) -> None:
        """Forget what arms held that were put somewhere else."""
        self._ticks[ids] = 0
