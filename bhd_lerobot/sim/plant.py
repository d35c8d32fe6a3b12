"""The joints of a world, as the cerebellum sees them."""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.errors import SimulationError
from bhd_lerobot.sim.world import World


class JointReading(Protocol):
    """What `SimulatedPlant.read` fills: any object with these two arrays, each of shape (n, joints)."""

    position: NDArray[np.float64]
    velocity: NDArray[np.float64]


class SimulatedPlant:
    """Reads the wheel joints of all simulations and writes their servos' speeds.

    It has the two calls of the cerebellum's plant and needs none of its code.

    Args:
        world: the simulations.
    """

    def __init__(self, world: World) -> None:
        self.n = world.n
        positions, velocities = world.joint_slice(world.body.drive.joints)
        self._position, self._velocity = world.qpos[:, positions], world.qvel[:, velocities]
        actuators = [world.model.actuator(name).id for name in world.body.drive.actuators]
        if actuators != list(range(actuators[0], actuators[0] + len(actuators))):
            raise SimulationError(f"Actuators {list(world.body.drive.actuators)} are not neighbours in the model.")
        self._ctrl = world.ctrl[:, actuators[0] : actuators[-1] + 1]

    def read(self, out: JointReading) -> None:
        """Write the joints' positions [rad] and velocities [rad/s], each of shape (n, joints), into `out`."""
        out.position[:] = self._position
        out.velocity[:] = self._velocity

    def write(self, ctrl: NDArray[np.float64]) -> None:
        """Take the servos' speeds [rad/s], shape (n, joints)."""
        self._ctrl[:] = ctrl
