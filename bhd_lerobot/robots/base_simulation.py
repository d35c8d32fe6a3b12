"""n simulated bases on two wheels under one cerebellum."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.arenas import Arena, make_arena
from bhd_lerobot.bodies.body import Drive, LidarSpec
from bhd_lerobot.bodies.truth import BaseTruth
from bhd_lerobot.control.messages import NANOSECONDS
from bhd_lerobot.control.plant import PlantReading
from bhd_lerobot.robots.base_host import BaseHost
from bhd_lerobot.robots.host.simulation import Simulation
from bhd_lerobot.sim.frames import Frames
from bhd_lerobot.sim.lidar import Lidar
from bhd_lerobot.sim.plant import SimulatedPlant
from bhd_lerobot.sim.world import World

if TYPE_CHECKING:  # it imports LeRobot, which the real-time process does without
    from bhd_lerobot.robots.config import MobileBaseConfig

_ANGLES = np.radians(np.arange(0.0, 360.0, 10.0))
_DIRECTIONS = np.stack([np.cos(_ANGLES), np.sin(_ANGLES), np.zeros(len(_ANGLES))], axis=1)
"""Unit vectors, counter-clockwise from ahead, in which a privileged state measures, shape (36, 3)."""


class BaseSimulation(BaseHost, Simulation):
    """n simulated bases.

    Args:
        threads: threads that step the physics; all processors if None.
    """

    host_class = BaseHost
    knows = None
    view = "follow"
    video_speed = 4

    def __init__(self, config: "MobileBaseConfig", n: int = 1, threads: int | None = None) -> None:
        body = config.body()
        drive, lidar = body.need(Drive), body.need(LidarSpec)
        world = World(body, n, physics_hz=config.physics_hz, threads=threads)
        self.lidar = Lidar(world, lidar, config.beams)
        self._radius, self._fastest = drive.radius, np.asarray(drive.limits.velocity)
        super().__init__(
            config,
            SimulatedPlant(world),
            world=world,
            camera_names=tuple(body.cameras) if config.camera else (),
        )
        self._reading = PlantReading(n, self._controller.joints)
        self._touch = self.world.sensor(drive.touch_sensor)[:, 0]
        self._gyro = self.world.sensor("imu_gyro")
        touches = np.zeros((1, n), np.bool_)
        self._touched = touches[0]
        self.scan_rate_hz = lidar.rate_hz
        self._scan_ticks = config.control_hz // lidar.rate_hz
        self._scanned_tick = np.zeros(n, np.int64)
        self._scans = np.zeros(n, np.int64)  # scans taken in the episode
        self._next_scan = 0
        gyro = "imu_gyro" if config.imu else None
        self._frames = Frames(world, self.cerebellum, touches, gyro=gyro, beams=config.beams)

    def truth(self) -> BaseTruth:
        """Return where the bases are, and whether they touched the scene since the start of the last frame."""
        return BaseTruth(self.world.base_pose, self._touched.copy())

    def privileged_state(self) -> NDArray[np.float64]:
        """Return how near the scene is now, without noise and delay, and the twists that are commanded, shape (n, 38).

        The first are the radius over the distance from the lidar in `_DIRECTIONS`, at most 1.
        """
        distance, _ = self.world.rays(self.lidar.spec.site, _DIRECTIONS)
        near = self._radius / np.maximum(distance, self._radius)
        return np.concatenate([near, self._controller.command / self._fastest], axis=1)

    def track(self, states: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the pose of the base in recorded states, shape (frames, 7)."""
        return states[:, :7]

    @property
    def not_in_state(self) -> tuple[str, ...]:
        """Odometry, the cerebellum's memory, and the gyroscope's readings, which are time derivatives."""
        odometry, imu = ("x.pos", "y.pos", "theta.pos"), ("imu_x.vel", "imu_y.vel", "imu_z.vel")
        return odometry * self.config.odometry + imu * self.config.imu

    def resense(self, sim: int, time_s: float, age_s: float) -> None:
        """Take the scans that were due until then: the noise of one that fell between two frames is drawn, too."""
        due = round((time_s - age_s) * self.scan_rate_hz) + 1
        while self._scans[sim] < due:
            self._scan(np.array([sim]))

    @classmethod
    def start_scene(cls, config: "MobileBaseConfig") -> Arena:
        """Return the configured arena."""
        return make_arena(config.arena, config.seed, robot_radius=config.body().need(Drive).radius)

    def place(self, ids: NDArray[np.intp], scenes: Sequence[Arena]) -> None:
        """Put robots into arenas, at rest at their start."""
        self.world.place([arena.shapes for arena in scenes], ids)
        self.world.reset(ids, np.array([arena.start for arena in scenes]))
        self._touched[ids] = False

    def _started(self, ids: NDArray[np.intp], seeds: Sequence[int]) -> None:
        self._scans[ids] = 0
        self._scan(ids)

    def sense(self) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Return the observation's floats, shape (n, features), and the tick of the oldest reading, shape (n,)."""
        self.plant.read(self._reading)
        parts = [self._controller.measured(self._reading), self.lidar.ranges]
        if self.config.odometry:
            parts.append(self._controller.odometry_at(self._reading.position))
        if self.config.imu:
            parts.append(self._gyro)
        return np.concatenate(parts, axis=1), self._scanned_tick

    @property
    def touches(self) -> tuple[NDArray[np.bool_], ...]:
        """Touches of the scene, shape (n,)."""
        return (self._touched,)

    def _after_step(self) -> None:
        np.logical_or(self._touched, self._touch, out=self._touched)

    def _after_tick(self) -> None:
        if self.config.imu:
            self.cerebellum.reading.sensors[:, self.config.beams :] = self._gyro
        if self.tick >= self._next_scan:
            due = self.running & (self.tick - self._scanned_tick >= self._scan_ticks)
            self._scan(np.flatnonzero(due))

    def run_ticks(self, number: int, most: int) -> int:
        """Run ticks up to the next scan, see `LockstepBridge`."""
        ticks = max(1, min(most, self._next_scan - self.tick))
        return super().run_ticks(number, ticks)

    def _scan(self, ids: NDArray[np.intp]) -> None:
        if len(ids):
            self.lidar.scan(self._rngs, ids)
            self._scanned_tick[ids] = self.tick
            reading = self.cerebellum.reading
            reading.sensors[ids, : self.config.beams] = self.lidar.ranges[ids]
            reading.sensors_ns[ids] = self.tick * NANOSECONDS // self.config.control_hz
            self._scans[ids] += 1
        running = self._scanned_tick[self.running]
        self._next_scan = (int(running.min()) if len(running) else self.tick) + self._scan_ticks
