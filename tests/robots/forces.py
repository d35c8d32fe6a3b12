"""What a simulated arm presses with, and what presses on it."""

from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.robots.host.simulation import Simulation

Array = NDArray[np.float64]


class Contacts:
    """The contacts of the first arm of a simulation, by its physics."""

    def __init__(self, arm: Simulation) -> None:
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


class Wall:
    """A wall that moves against the tools of an arm's simulations: a spring and a damper that only push.

    Args:
        simulation: the arms.
        direction: in which it pushes, world frame, shape (3,) or (n, 3).
        speed: with which it comes [m/s], one number or of each arm, as those that follow.
        seconds: for which it comes; then it stays where it is.
        stiffness: of what it is made of [N/m].

    Attributes:
        force: with which it pushes each tool now [N], shape (n,).
    """

    def __init__(self, simulation: Simulation, direction: Any, speed: Any, seconds: Any, stiffness: Any = 2e4) -> None:
        world, self._hz = simulation.world, simulation.rates.control_hz
        self._direction = np.asarray(direction) / np.linalg.norm(direction, axis=-1, keepdims=True)
        self._speed, self._seconds, self._stiffness = speed, seconds, stiffness
        self._external, self._centre = world._batch.bind("xfrc_applied"), world.derived("xipos")
        self._body, self._tool = world.model.body("gripper").id, world.site("tool").position
        self._start, self._last = self._tool.copy(), self._tool.copy()
        self._tick, self.force = 0, np.zeros(simulation.n)
        after = simulation._after_tick

        def push() -> None:
            after()
            self._push()

        simulation._after_tick = push  # type: ignore[method-assign]

    def _push(self) -> None:
        self._tick += 1
        time, tool = self._tick / self._hz, self._tool
        comes = self._speed * np.minimum(time, self._seconds) - 0.003
        depth = comes - ((tool - self._start) * self._direction).sum(axis=1)
        speed = self._speed * (time < self._seconds)
        speed = speed - ((tool - self._last) * self._direction).sum(axis=1) * self._hz
        self._last = tool.copy()
        self.force = np.where(depth > 0.0, np.maximum(self._stiffness * depth + 50.0 * speed, 0.0), 0.0)
        force = self.force[:, None] * self._direction
        self._external[:, self._body, :3] = force
        self._external[:, self._body, 3:] = np.cross(tool - self._centre[:, self._body], force)
