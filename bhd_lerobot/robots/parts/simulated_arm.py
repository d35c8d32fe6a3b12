"""n simulated arms, and what lies on their tables."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Body
from bhd_lerobot.control.arm.controller import ArmController
from bhd_lerobot.control.geometry.poses import pose_vectors
from bhd_lerobot.control.motion.planning import Planning
from bhd_lerobot.control.plant import PlantReading
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.robots.parts.arm import ArmPart, table_of
from bhd_lerobot.robots.parts.latency import LatePlant
from bhd_lerobot.robots.parts.part import Ids, SimulatedPart
from bhd_lerobot.sim.tabletop import Tabletop
from bhd_lerobot.sim.world import World

_MAX_TORQUE_LATENCY = 0.01  # [s] the default impedance becomes unstable somewhere between 0.02 and 0.05
_SPEED_NOISE = 10.0  # [1/s] noise on speeds, as a multiple of the noise on positions


class SimulatedArm(ArmPart, SimulatedPart):
    """n simulated arms.

    Attributes:
        table: what lies on the tables.
    """

    touch_kinds = 3  # of the table, of objects with a link of the arm, and of the arm with itself

    def __init__(self, config: Any, body: Body, plant: LatePlant, world: World, planning: Planning | None) -> None:
        super().__init__(config, body, plant, planning)
        self._world, self._plant, self.table = world, plant, Tabletop(world)
        self._noise = np.zeros(world.n)

    def place(self, ids: Ids, scenes: Sequence[Any]) -> None:
        """Put the arms and their objects where the scenes want them, at rest."""
        tables = [table_of(scene, self.table.arm.home) for scene in scenes]
        latency = [table.variation.latency_s for table in tables]
        if self.config.control == "impedance" and max(latency, default=0.0) > _MAX_TORQUE_LATENCY:
            raise ConfigError(
                f"latency_s is {max(latency)}; with robot.control = impedance the torque loop is stable with at most "
                f"{_MAX_TORQUE_LATENCY} s."
            )
        self.table.place(tables, ids)
        self._noise[ids] = [table.variation.sensor_noise for table in tables]
        self._plant.set_latency(ids, [round(late * self.config.control_hz) for late in latency])
        if isinstance(self.controller, ArmController):
            self.controller.set_latency(ids, latency)

    def track(self, states: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the pose of the tool in recorded states, shape (frames, 7)."""
        joints, _ = self._world.joint_slice(self.kinematics.chain.joints)
        return pose_vectors(self.kinematics.tool(states[:, joints]))

    def truth(self, reading: PlantReading) -> dict[str, Any]:
        """Return where tool and objects are, and what the arms touched since the start of the last frame."""
        on_table, on_object, itself = self.touches.copy()
        return {
            "tool_pose": self.table.tool_pose,
            "object_poses": self.table.object_poses,
            "opening": self._opening(reading.position),
            "arm_on_table": on_table,
            "arm_on_object": on_object,
            "self_contact": itself,
            "fingers_on_object": np.array(self.table.finger_on_object),
        }

    def sense(self, reading: PlantReading, out: NDArray[np.float64]) -> None:
        """Write positions and speeds of the joints, with their noise."""
        super().sense(reading, out)
        if np.count_nonzero(self._noise):
            joints, speeds = self._joints, slice(self._values, self._values + self._joints)
            for sim in np.flatnonzero((self._noise > 0) & self.host.running):
                noise = self.host.rngs[sim].normal(0.0, self._noise[sim], (2, joints))
                out[sim, :joints] += noise[0]
                out[sim, speeds] += noise[1] * _SPEED_NOISE

    def after_step(self) -> None:
        """Note touches."""
        table = self.table
        if not table.is_touching_more:
            return
        on_table, on_object, itself = self.touches
        np.logical_or(on_table, table.arm_on_table, out=on_table)
        np.logical_or(on_object, table.arm_on_object, out=on_object)
        np.logical_or(itself, table.self_contact, out=itself)
