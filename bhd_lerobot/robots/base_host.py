"""n bases on two wheels under one cerebellum, whatever is below it: what they observe and how they act."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Drive, LidarSpec, without_jerk_limits
from bhd_lerobot.bodies.truth import BaseTruth
from bhd_lerobot.control.cerebellum import Cerebellum
from bhd_lerobot.control.collision_monitor import new_monitors
from bhd_lerobot.control.drive import BaseController
from bhd_lerobot.control.messages import NANOSECONDS
from bhd_lerobot.control.plant import Plant
from bhd_lerobot.robots.host.host import Host

if TYPE_CHECKING:  # it imports LeRobot, which the real-time process does without
    from bhd_lerobot.robots.config import MobileBaseConfig

_ODOMETRY, _GYRO = ("x.pos", "y.pos", "theta.pos"), ("imu_x.vel", "imu_y.vel", "imu_z.vel")


class BaseHost(Host):
    """n bases.

    A plant takes wheel speeds, or twists (`Plant.takes`). Its further sensors, `PlantReading.sensors`, are the ranges
    of the scan [m], counter-clockwise from ahead, and with `imu` the three rates of the gyroscope [rad/s].

    Attributes:
        plant: the wheels.

    Args:
        config: the robot.
        plant: the wheels.
        options: those of `Host`.
    """

    action_names = ("x.vel", "theta.vel")
    knows: frozenset[str] | None = frozenset({"base_pose_in_world"})

    def __init__(self, config: "MobileBaseConfig", plant: Plant, **options: Any) -> None:
        body = config.body() if config.jerk_limits else without_jerk_limits(config.body())
        drive, lidar = body.need(Drive), body.need(LidarSpec)
        self.plant = plant
        monitors = None
        if config.collision_monitor:
            monitors = new_monitors(drive, lidar, plant.n, config.control_hz, config.beams)
        gyro = config.beams + _GYRO.index("imu_z.vel") if config.imu else None
        self._controller = BaseController(
            drive,
            plant.n,
            config.control_hz,
            monitors=monitors,
            gyro=gyro,
            takes=plant.takes,
            latency_s=plant.latency_s,
        )
        super().__init__(
            config,
            Cerebellum(
                body, plant, config.control_hz, controller=self._controller, sensors=config.beams + 3 * config.imu
            ),
            action_names=self.action_names,
            observation_names=observation_names(config),
            **options,
        )
        self.sensor_period_s = 1 / lidar.rate_hz
        self._start = np.zeros((plant.n, 3))  # where odometry began, in the scene: x, y [m], yaw [rad]

    def sense(self) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Return the observation's floats, shape (n, features), and the tick of the oldest reading, shape (n,)."""
        reading, beams = self.cerebellum.reading, self.config.beams
        parts = [self._controller.measured(reading), reading.sensors[:, :beams]]
        if self.config.odometry:
            parts.append(self._controller.odometry_at(reading.position))
        if self.config.imu:
            parts.append(reading.sensors[:, beams:])
        age = np.zeros(self.n, np.int64)
        if reading.stamp_ns is not None:
            age = np.abs(reading.stamp_ns - reading.sensors_ns) * self.rates.control_hz // NANOSECONDS
        return np.concatenate(parts, axis=1), self.tick - age

    def truth(self) -> BaseTruth:
        """Return where the bases are by their wheels' odometry; nothing is known of touches."""
        turn, odometry = self._start[:, 2], self._controller.odometry()
        pose = self._start + odometry
        pose[:, 0] = self._start[:, 0] + np.cos(turn) * odometry[:, 0] - np.sin(turn) * odometry[:, 1]
        pose[:, 1] = self._start[:, 1] + np.sin(turn) * odometry[:, 0] + np.cos(turn) * odometry[:, 1]
        return BaseTruth(pose, np.zeros(self.n, np.bool_))

    def place(self, ids: NDArray[np.intp], scenes: Sequence[Any]) -> None:
        """Take over where in their arenas the bases start: a person has put them there."""
        self._start[ids] = [(0.0, 0.0, 0.0) if arena is None else arena.start for arena in scenes]

    def track(self, states: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the pose of the base in recorded observations, from where it started, shape (frames, 7)."""
        states = np.asarray(states, np.float64)
        names = list(self.observation_names)
        if self.config.odometry:
            x, y, yaw = (states[:, names.index(name)] for name in _ODOMETRY)
        else:
            yaw = np.cumsum(states[:, 1]) / self.rates.fps
            x, y = np.cumsum(states[:, 0] * np.cos(yaw)), np.cumsum(states[:, 0] * np.sin(yaw))
            x, y = x / self.rates.fps, y / self.rates.fps
        zero = np.zeros(len(states))
        return np.stack([x, y, zero, np.cos(yaw / 2), zero, zero, np.sin(yaw / 2)], axis=1)


def observation_names(config: "MobileBaseConfig") -> tuple[str, ...]:
    """Return the names of the observation's floats, in order."""
    names = ["x.vel", "theta.vel", *(f"scan_{beam:03d}.pos" for beam in range(config.beams))]
    if config.odometry:
        names += _ODOMETRY
    if config.imu:
        names += _GYRO
    return tuple(names)
