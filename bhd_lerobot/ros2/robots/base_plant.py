"""A TurtleBot3, or another base on two wheels with its topics, below the cerebellum."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Body, Drive, LidarSpec
from bhd_lerobot.control.messages import NANOSECONDS
from bhd_lerobot.control.plant import PlantReading
from bhd_lerobot.errors import RealtimeError
from bhd_lerobot.ros2.live.network import SENSOR_DATA
from bhd_lerobot.ros2.live.spec import InputSpec, OutputSpec
from bhd_lerobot.ros2.messages.presets import columns
from bhd_lerobot.ros2.messages.table import (
    GYRO,
    IMU_TYPE,
    JOINTS,
    SCAN,
    STAMPED_TWIST,
    TWIST,
    TWIST_TYPE,
    joint_columns,
)
from bhd_lerobot.ros2.robots.plant import Ros2Plant, scan_reader

_STOP = (0.0, 0.0)
_NODE_SILENCE_S = 0.5  # of topics at 20 Hz
_SCAN_SILENCE_S = 1.0  # of scans at 5 Hz
_FASTER = 2.0  # times the wheels' largest speed, which none is


class BasePlant(Ros2Plant):
    """A base with the topics of a TurtleBot3: ``/joint_states``, ``/scan``, by option ``/imu``; ``/cmd_vel``.

    The robot's node continues with its last command for ever: the stop is sent when commands cease.
    """

    takes = "twist"
    command_hz = 50.0
    usual_latency_s = 0.3
    moves = 0.05  # [m/s] of a wheel

    def __init__(self, config: Any, body: Body) -> None:
        drive, lidar = body.need(Drive), body.need(LidarSpec)
        beams = config.beams
        self._beams, self._has_gyro = beams, config.imu
        self._half_track, self._wheel_radius = drive.wheel_separation / 2, drive.wheel_radius
        self._unit, self._fastest = config.ros2.wheel_speeds, _FASTER * drive.max_wheel_speed
        node_silence = self._longest_s = max(_NODE_SILENCE_S, config.ros2.silent_s)
        self._wheels: NDArray[np.float64] | None = None  # as they were read last, and when
        self._read_ns = 0
        self._counted_before = np.zeros(2)  # [rad] by wheels, before their driver began to count anew
        twist_type = TWIST_TYPE if config.ros2.distro == "humble" else STAMPED_TWIST
        inputs = [
            InputSpec.of(columns("/joint_states", JOINTS, joint_columns(drive.joints)), SENSOR_DATA, node_silence),
            InputSpec(
                "/scan",
                SCAN,
                scan_reader(config.ros2, "/scan", lidar, beams),
                SENSOR_DATA,
                max(_SCAN_SILENCE_S, config.ros2.silent_s),
            ),
        ]
        if config.imu:
            inputs.append(InputSpec.of(columns("/imu", IMU_TYPE, GYRO), SENSOR_DATA, node_silence))
        other = "humble" if twist_type == STAMPED_TWIST else "jazzy"
        remedy = f"Set --robot.ros2.distro={other}."
        output = OutputSpec.of(columns("/cmd_vel", twist_type, TWIST), remedy=remedy, stop=_STOP)
        super().__init__(body.name, config, tuple(inputs), (output,))

    def commanded(self, ctrl: NDArray[np.float64]) -> float:
        """Return the speed of the faster wheel [m/s]."""
        return abs(float(ctrl[0, 0])) + abs(float(ctrl[0, 1])) * self._half_track

    def moved(self, out: PlantReading) -> float:
        """Return the speed of the faster wheel [m/s]."""
        return float(np.abs(out.velocity[0]).max()) * self._wheel_radius

    def read_parts(self, state: Any, out: PlantReading) -> None:
        """Write the wheels, the scan and the gyroscope into `out`."""
        wheels, measured = self.numbers(state, 0), state["measured_ns"]
        out.position[0] = self._turned(wheels[:2], int(measured[0]))
        out.velocity[0] = wheels[2:] / (self._wheel_radius if self._unit == "m/s" else 1.0)
        if (fastest := np.abs(out.velocity[0]).max()) > self._fastest:
            raise RealtimeError(
                f"A wheel turns at {fastest:.0f} rad/s by {self.link.spec.inputs[0].topic}, whose speeds are taken for "
                f"{self._unit}; none is faster than {self._fastest:.0f}. Gazebo needs --robot.ros2.wheel_speeds=rad/s."
            )
        out.sensors[0, : self._beams] = self.numbers(state, 1)
        if self._has_gyro:
            out.sensors[0, self._beams :] = self.numbers(state, 2)
        if out.stamp_ns is not None:
            out.stamp_ns[0] = measured[0]
        out.sensors_ns[0] = measured[1:].min()

    def _turned(self, angles: NDArray[np.float64], measured_ns: int) -> NDArray[np.float64]:
        """Return how far the wheels have turned [rad], shape (2,), also after a new start of their driver.

        After a silence, which stopped the robot, a count that no wheel can have reached is one from 0; what they turned
        meanwhile is not known. Without a silence it is a false reading, and is passed on to the check of readings.
        """
        if self._wheels is None:
            self._wheels, self._read_ns = angles.copy(), measured_ns
        step = angles - self._wheels
        was_silent = measured_ns - self._read_ns > self._longest_s * NANOSECONDS
        if was_silent and np.abs(step).max() > self._fastest * self._longest_s:
            self._counted_before -= step
        self._wheels, self._read_ns = angles.copy(), measured_ns
        return angles + self._counted_before
