"""What a simulated arm presses with."""

import mujoco
import numpy as np

from bhd_lerobot.robots.ur5_simulation import UR5Simulation


class Contacts:
    """The contacts of the first arm of a simulation, by its physics."""

    def __init__(self, arm: UR5Simulation) -> None:
        self._world = arm.world
        self._model = arm.world.copy_model(0)
        self._data = mujoco.MjData(self._model)

    def force(self, *geoms: str) -> float:
        """Return the sum of the normal forces now, between two geoms if they are named [N]."""
        pair = {self._model.geom(name).id for name in geoms}
        self._world.copy_into(0, self._model, self._data)
        self._data.ctrl[:] = self._world.ctrl[0]
        mujoco.mj_forward(self._model, self._data)
        wrench, total = np.zeros(6), 0.0
        for number in range(self._data.ncon):
            if not pair or set(self._data.contact[number].geom) == pair:
                mujoco.mj_contactForce(self._model, self._data, number, wrench)
                total += abs(wrench[0])
        return total
