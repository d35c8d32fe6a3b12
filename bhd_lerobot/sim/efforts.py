"""The torques of a world's actuators, averaged over the physics steps of a control tick."""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.sim.engine import mujoco

Array = NDArray[np.float64]
Rows = NDArray[np.intp] | slice


class MeanEfforts:
    """Averages what the actuators of n simulations put on their joints.

    MuJoCo reports the torque that a servo gives at the speed before a step. Its implicit integrators damp the speed
    after the step, so that another torque acts: less by the damping times the change of the speed, where the servo is
    not at the end of its range. Of a UR5's shoulder that is 1.6 N m for each rad/s^2 with steps of 2 ms.

    Attributes:
        is_exact: whether what acted is averaged.
        mean: what acted on average over the last steps [N m; N for a slide], shape (n, nv), live.

    Args:
        exact: average what acted; what MuJoCo reports if False.
    """

    def __init__(self, model: mujoco.MjModel, bind: Callable[[str], Array], *, exact: bool) -> None:
        self._bind, self.is_exact = bind, exact
        self._reported = bind("qfrc_actuator")
        self.mean: Array = self._reported.copy()
        self._servos = np.flatnonzero(model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT)
        joints = model.actuator_trnid[self._servos, 0]
        self._dofs = model.jnt_dofadr[joints]
        self._gear = model.actuator_gear[self._servos, 0]
        self._damping = -model.actuator_biasprm[self._servos, 2]
        limited, largest = model.actuator_forcelimited[self._servos], model.actuator_forcerange[self._servos, 1]
        self._most_force = np.where(limited, largest, np.inf)
        # Before version 4 MuJoCo damps also where the joint's own limit, and not the servo's, cuts the torque off.
        counts = model.jnt_actfrclimited[joints] & (mujoco.mj_version() >= 4_000_000)
        self._most_torque = np.where(counts, model.jnt_actfrcrange[joints, 1], np.inf)

    def are_all(self, servos: Sequence[int]) -> bool:
        """Return whether these servos of joints, by their numbers, are all that damp speeds."""
        return set(self._servos[self._damping != 0.0].tolist()) <= set(servos) <= set(self._servos.tolist())

    def numbers(self, actuators: Sequence[int]) -> dict[str, Array]:
        """Return gear, damping, largest force and largest torque of some servos by their numbers in the model."""
        places = np.searchsorted(self._servos, actuators)
        values = {"gear": self._gear, "damping": self._damping}
        values |= {"most_force": self._most_force, "most_torque": self._most_torque}
        return {name: value[places] for name, value in values.items()}

    def note(self, rows: Rows, step: int, steps: int) -> None:
        """Take one of the steps of a tick into account, of the simulations in `rows`."""
        values = self._acted() if self.is_exact or steps > 1 else self._reported
        self.mean[rows] = values[rows] if step == 0 else self.mean[rows] + values[rows]
        if step == steps - 1 > 0:
            self.mean[rows] /= steps

    def forward(self, rows: Rows) -> None:
        """Take over what derives from a state that no step led to."""
        self.mean[rows] = self._reported[rows]

    def _acted(self) -> Array:
        """Return what acted in the last step, shape (n, nv)."""
        servos, dofs, gear = self._servos, self._dofs, self._gear
        force = np.abs(self._bind("actuator_force")[:, servos])
        inside = (force < self._most_force) & (np.abs(self._reported[:, dofs]) < self._most_torque)
        change = gear * self._bind("qvel")[:, dofs] - self._bind("actuator_velocity")[:, servos]
        acted = self._reported.copy()
        acted[:, dofs] -= gear * self._damping * change * inside
        return acted
