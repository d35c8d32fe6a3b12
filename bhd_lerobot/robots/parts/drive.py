"""The drives and lidars of n robots, whatever is below them: what they observe and how they act."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Body, Drive, LidarSpec
from bhd_lerobot.bodies.tabletop import TableScene
from bhd_lerobot.control.collision_monitor import new_monitors
from bhd_lerobot.control.controller import Controller
from bhd_lerobot.control.drive import BaseController, twist_from_wheels
from bhd_lerobot.control.messages import NANOSECONDS
from bhd_lerobot.control.plant import Plant, PlantReading
from bhd_lerobot.robots.parts.names import GYRO_NAMES, ODOMETRY_NAMES, TWIST_NAMES, drive_observation_names
from bhd_lerobot.robots.parts.part import Ids, Part


class DrivePart(Part):
    """n drives.

    A plant takes wheel speeds, or twists (`Plant.takes`). Its further sensors, `PlantReading.sensors`, are the ranges
    of the scan [m], counter-clockwise from ahead, and with `imu` the three rates of the gyroscope [rad/s].

    Args:
        config: the robot.
        body: its hardware.
        plant: what it drives with.
        arm: the controller of the arms on them.
    """

    action_names = TWIST_NAMES
    knows = frozenset({"base_pose_in_world"})

    def __init__(self, config: Any, body: Body, plant: Plant, arm: Controller | None = None) -> None:
        drive, lidar = body.need(Drive), body.need(LidarSpec)
        monitors = None
        if config.collision_monitor:
            monitors = new_monitors(drive, lidar, plant.n, config.control_hz, config.beams)
        self.controller: BaseController = BaseController(
            drive,
            plant.n,
            config.control_hz,
            monitors=monitors,
            gyro=config.beams + GYRO_NAMES.index("imu_z.vel") if config.imu else None,
            takes=plant.takes,
            latency_s=plant.latency_s,
            arm=arm,
        )
        self.config, self.observation_names = config, drive_observation_names(config)
        self.sensors, self.sensor_period_s = config.beams + 3 * config.imu, 1 / lidar.rate_hz
        self.first = 0 if arm is None else arm.joints
        self._start = np.zeros((plant.n, 3))  # where odometry began, in the scene: x, y [m], yaw [rad]

    def _scan_and_rates(self, reading: PlantReading) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the ranges of the scan, shape (n, beams), and the gyroscope's rates, shape (n, 3 or 0)."""
        beams = self.config.beams
        return reading.sensors[:, :beams], reading.sensors[:, beams:]

    def sense(self, reading: PlantReading, out: NDArray[np.float64]) -> None:
        """Write its observation's floats, shape (n, features)."""
        wheels, end = slice(self.first, self.first + 2), 2 + self.config.beams
        scan, rates = self._scan_and_rates(reading)
        out[:, :2], out[:, 2:end] = twist_from_wheels(self.controller.drive, reading.velocity[:, wheels]), scan
        if self.config.odometry:
            out[:, end : (end := end + 3)] = self.controller.odometry_at(reading.position[:, wheels])
        if self.config.imu:
            out[:, end:] = rates

    def oldest(self) -> NDArray[np.int64]:
        """Return the tick of its oldest reading, shape (n,)."""
        host, reading = self.host, self.host.cerebellum.reading
        age = np.zeros(host.n, np.int64)
        if reading.stamp_ns is not None:
            age = np.abs(reading.stamp_ns - reading.sensors_ns) * host.rates.control_hz // NANOSECONDS
        return host.tick - age

    def truth(self, reading: PlantReading) -> dict[str, Any]:
        """Return where the bases are by their wheels' odometry; nothing is known of touches."""
        turn, odometry = self._start[:, 2], self.controller.odometry()
        pose = self._start + odometry
        pose[:, 0] = self._start[:, 0] + np.cos(turn) * odometry[:, 0] - np.sin(turn) * odometry[:, 1]
        pose[:, 1] = self._start[:, 1] + np.sin(turn) * odometry[:, 0] + np.cos(turn) * odometry[:, 1]
        return {"base_pose_in_world": pose, "touched": np.zeros(len(pose), np.bool_)}

    def place(self, ids: Ids, scenes: Sequence[Any]) -> None:
        """Take over where in their arenas the bases start: a person has put them there."""
        self._start[ids] = [(0.0, 0.0, 0.0) if scene is None else arena_of(scene).start for scene in scenes]

    def track(self, states: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the pose of the base in recorded observations, from where it started, shape (frames, 7)."""
        states = np.asarray(states, np.float64)
        names, fps = list(self.host.observation_names), self.host.rates.fps
        if self.config.odometry:
            x, y, yaw = (states[:, names.index(name)] for name in ODOMETRY_NAMES)
        else:
            forward, turn = (states[:, names.index(name)] for name in TWIST_NAMES)
            yaw = np.cumsum(turn) / fps
            x, y = np.cumsum(forward * np.cos(yaw)) / fps, np.cumsum(forward * np.sin(yaw)) / fps
        zero = np.zeros(len(states))
        return np.stack([x, y, zero, np.cos(yaw / 2), zero, zero, np.sin(yaw / 2)], axis=1)


def arena_of(scene: Any) -> Any:
    """Return the arena of a scene, which is one, or has one; an empty one of a scene that is a tabletop alone."""
    if isinstance(scene, TableScene) and not hasattr(scene, "arena"):
        from bhd_lerobot.bodies.arenas import make_arena  # imports SciPy

        return make_arena("empty", 0)
    return getattr(scene, "arena", scene)
