"""The drives and lidars of n simulated robots."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Body, Drive, LidarSpec
from bhd_lerobot.control.controller import Controller
from bhd_lerobot.control.messages import NANOSECONDS
from bhd_lerobot.control.plant import Plant, PlantReading
from bhd_lerobot.robots.parts.drive import DrivePart, arena_of
from bhd_lerobot.robots.parts.names import GYRO_NAMES, ODOMETRY_NAMES
from bhd_lerobot.robots.parts.part import GYROSCOPE, Ids, SimulatedPart
from bhd_lerobot.sim.lidar import Lidar
from bhd_lerobot.sim.world import World

_ANGLES = np.radians(np.arange(0.0, 360.0, 10.0))
_DIRECTIONS = np.stack([np.cos(_ANGLES), np.sin(_ANGLES), np.zeros(len(_ANGLES))], axis=1)
"""Unit vectors, counter-clockwise from ahead, in which a privileged state measures, shape (36, 3)."""


class SimulatedDrive(DrivePart, SimulatedPart):
    """n simulated drives.

    Attributes:
        lidar: the range finders.
    """

    touch_kinds = 1

    def __init__(self, config: Any, body: Body, plant: Plant, world: World, arm: Controller | None = None) -> None:
        super().__init__(config, body, plant, arm)
        drive, lidar = body.need(Drive), body.need(LidarSpec)
        self._world, self.lidar = world, Lidar(world, lidar, config.beams)
        self._radius, self._fastest = drive.radius, np.asarray(drive.limits.velocity)
        self._touch = world.sensor(drive.touch_sensor)[:, 0]
        self._gyro = world.sensor(GYROSCOPE) if config.imu else np.zeros((world.n, 0))
        self._scan_hz, self._scan_ticks = lidar.rate_hz, config.control_hz // lidar.rate_hz
        self._scanned_tick, self._scans = np.zeros((2, world.n), np.int64)  # scans taken in the episode
        self._next_scan = 0

    def _scan_and_rates(self, reading: PlantReading) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        return self.lidar.ranges, self._gyro

    def oldest(self) -> NDArray[np.int64]:
        """Return the tick of the last scans, shape (n,)."""
        return self._scanned_tick

    def truth(self, reading: PlantReading) -> dict[str, Any]:
        """Return where the bases are, and whether they touched the scene since the start of the last frame."""
        return {"base_pose_in_world": self._world.base_pose, "touched": self.touches[0].copy()}

    def track(self, states: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the pose of the base in recorded states, shape (frames, 7)."""
        return states[:, :7]

    def privileged_state(self) -> NDArray[np.float64]:
        """Return how near the scene is now, without noise and delay, and the twists that are commanded, shape (n, 38).

        The first are the radius over the distance from the lidar in `_DIRECTIONS`, at most 1.
        """
        distance, _ = self._world.rays(self.lidar.spec.site, _DIRECTIONS)
        near = self._radius / np.maximum(distance, self._radius)
        return np.concatenate([near, self.controller.command / self._fastest], axis=1)

    @property
    def not_in_state(self) -> tuple[str, ...]:
        """Odometry, the cerebellum's memory, and the gyroscope's readings, which are time derivatives."""
        return ODOMETRY_NAMES * self.config.odometry + GYRO_NAMES * self.config.imu

    def resense(self, sim: int, time_s: float, age_s: float) -> None:
        """Take the scans that were due until then: the noise of one that fell between two frames is drawn, too."""
        due = round((time_s - age_s) * self._scan_hz) + 1
        while self._scans[sim] < due:
            self._scan(np.array([sim]))

    def place(self, ids: Ids, scenes: Sequence[Any]) -> None:
        """Put robots into arenas, at rest at their start."""
        arenas = [arena_of(scene) for scene in scenes]
        self._world.place([arena.shapes for arena in arenas], ids)
        self._world.reset(ids, np.array([arena.start for arena in arenas]))

    def started(self, ids: Ids) -> None:
        """Take a first scan."""
        self._scans[ids] = 0
        self._scan(ids)

    def after_step(self) -> None:
        """Note touches."""
        np.logical_or(self.touches[0], self._touch, out=self.touches[0])

    def after_tick(self) -> None:
        """Take the scans that are due."""
        if self.config.imu:
            self.host.cerebellum.reading.sensors[:, self.config.beams :] = self._gyro
        if self.host.tick >= self._next_scan:
            due = self.host.running & (self.host.tick - self._scanned_tick >= self._scan_ticks)
            self._scan(np.flatnonzero(due))

    def ticks_left(self) -> int:
        """Return the number of ticks until the next scan."""
        return max(1, self._next_scan - self.host.tick)

    def _scan(self, ids: Ids) -> None:
        host = self.host
        if len(ids):
            self.lidar.scan(host.rngs, ids)
            self._scanned_tick[ids] = host.tick
            reading = host.cerebellum.reading
            reading.sensors[ids, : self.config.beams] = self.lidar.ranges[ids]
            reading.sensors_ns[ids] = host.tick * NANOSECONDS // self.config.control_hz
            self._scans[ids] += 1
        running = self._scanned_tick[host.running]
        self._next_scan = (int(running.min()) if len(running) else host.tick) + self._scan_ticks
