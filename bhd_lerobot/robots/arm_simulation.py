"""n simulated arms under one cerebellum."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Arm, Shape
from bhd_lerobot.bodies.tabletop import MAX_LATENCY_S, TableScene
from bhd_lerobot.bodies.truth import ArmTruth
from bhd_lerobot.control.arm.controller import ArmController
from bhd_lerobot.control.geometry.poses import pose_vectors
from bhd_lerobot.control.motion.planning import Planning
from bhd_lerobot.control.plant import PlantReading
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.robots.arm_host import ArmHost
from bhd_lerobot.robots.host.simulation import Simulation
from bhd_lerobot.robots.latency import LatePlant
from bhd_lerobot.sim.frames import Frames
from bhd_lerobot.sim.plant import SimulatedPlant
from bhd_lerobot.sim.tabletop import Tabletop
from bhd_lerobot.sim.world import World

if TYPE_CHECKING:  # it imports LeRobot, which the real-time process does without
    from bhd_lerobot.robots.config_arm import ArmConfig

_MAX_TORQUE_LATENCY = 0.01  # [s] the default impedance becomes unstable somewhere between 0.02 and 0.05
_SPEED_NOISE = 10.0  # [1/s] noise on speeds, as a multiple of the noise on positions


class ArmSimulation(ArmHost, Simulation):
    """n simulated arms.

    Attributes:
        table: what lies on the tables.

    Args:
        config: the robot.
        n: how many.
        threads: threads that step the physics; all processors if None.
        planning: who plans goals; they are planned in the tick that they start in if None.
        fixtures: what stands immovable on the tables, unknown to the arms.
    """

    host_class = ArmHost
    knows = None
    plant: LatePlant

    def __init__(
        self,
        config: "ArmConfig",
        n: int = 1,
        threads: int | None = None,
        planning: Planning | None = None,
        *,
        fixtures: Sequence[Shape] = (),
    ) -> None:
        body = config.body()
        world = World(body, n, physics_hz=config.physics_hz, threads=threads, fixtures=fixtures)
        self.table = Tabletop(world)
        super().__init__(
            config,
            LatePlant(SimulatedPlant(world), len(body.limits.names), round(MAX_LATENCY_S * config.control_hz)),
            planning,
            world=world,
            camera_names=tuple(body.cameras) if config.camera else (),
        )
        self._reading = PlantReading(n, self.controller.joints)
        self._noise = np.zeros(n)
        self._now = np.ones(n, np.int64)  # times the tick
        touches = np.zeros((3, n), np.bool_)
        self._arm_on_table, self._arm_on_object, self._self_contact = touches
        self._frames = Frames(world, self.cerebellum, touches, late=self.plant, brakes=self.plant.plant.brakes)

    @classmethod
    def start_scene(cls, config: "ArmConfig") -> TableScene:
        """Return the configured scene: empty, or one of a task."""
        from bhd_lerobot.tasks.pick import PickConfig, PickTask
        from bhd_lerobot.tasks.reach import ReachConfig, ReachTask

        if config.scene == "reach":
            return ReachTask(ReachConfig(), 1, config.fps, config.body()).sample(config.seed)
        if config.scene == "pick":
            return PickTask(PickConfig(), 1, config.fps, config.body()).sample(config.seed)
        return TableScene("empty", (), config.body().need(Arm).home)

    def place(self, ids: NDArray[np.intp], scenes: Sequence[TableScene]) -> None:
        """Put the arms and their objects where the scenes want them, at rest."""
        latency = [scene.variation.latency_s for scene in scenes]
        if self.config.control == "impedance" and max(latency, default=0.0) > _MAX_TORQUE_LATENCY:
            raise ConfigError(
                f"latency_s is {max(latency)}; with robot.control = impedance the torque loop is stable with at most "
                f"{_MAX_TORQUE_LATENCY} s."
            )
        self.table.place(scenes, ids)
        self._noise[ids] = [scene.variation.sensor_noise for scene in scenes]
        self.plant.set_latency(ids, [round(late * self.rates.control_hz) for late in latency])
        if isinstance(self.controller, ArmController):
            self.controller.set_latency(ids, latency)
        for flags in self.touches:
            flags[ids] = False

    def track(self, states: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the pose of the tool in recorded states, shape (frames, 7)."""
        joints, _ = self.world.joint_slice(self.kinematics.chain.joints)
        return pose_vectors(self.kinematics.tool(states[:, joints]))

    def truth(self) -> ArmTruth:
        """Return where tool and objects are, and what the arms touched since the start of the last frame."""
        return ArmTruth(
            tool_pose=self.table.tool_pose,
            object_poses=self.table.object_poses,
            opening=self._opening(self._newest().position),
            arm_on_table=self._arm_on_table.copy(),
            arm_on_object=self._arm_on_object.copy(),
            self_contact=self._self_contact.copy(),
            fingers_on_object=np.array(self.table.finger_on_object),
        )

    def sense(self) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Return the observation's floats, shape (n, features), and the tick of the oldest reading, shape (n,)."""
        reading = self._newest()
        state = np.concatenate([reading.position, reading.velocity], axis=1)
        if np.count_nonzero(self._noise):
            joints, width = self._joints, state.shape[1] // 2
            for sim in np.flatnonzero((self._noise > 0) & self.running):
                noise = self._rngs[sim].normal(0.0, self._noise[sim], (2, joints))
                state[sim, :joints] += noise[0]
                state[sim, width : width + joints] += noise[1] * _SPEED_NOISE
        return self._observed(state), self._now * self.tick

    def _newest(self) -> PlantReading:
        self.plant.read(self._reading)
        return self._reading

    @property
    def touches(self) -> tuple[NDArray[np.bool_], ...]:
        """Touches of the table, of objects with a link of the arm, and of the arm with itself, each of shape (n,)."""
        return self._arm_on_table, self._arm_on_object, self._self_contact

    def _after_step(self) -> None:
        table = self.table
        if not table.is_touching_more:
            return
        np.logical_or(self._arm_on_table, table.arm_on_table, out=self._arm_on_table)
        np.logical_or(self._arm_on_object, table.arm_on_object, out=self._arm_on_object)
        np.logical_or(self._self_contact, table.self_contact, out=self._self_contact)
