"""A TurtleBot3, or another base on two wheels with its topics, below the cerebellum."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import MobileBase
from bhd_lerobot.control.plant import PlantReading
from bhd_lerobot.errors import DatasetError
from bhd_lerobot.ros2.live.network import SENSOR_DATA
from bhd_lerobot.ros2.live.spec import InputSpec, OutputSpec
from bhd_lerobot.ros2.messages.base import BareTwistPart, GyroPart, ScanPart, TwistPart, twist_tree
from bhd_lerobot.ros2.messages.parts import header
from bhd_lerobot.ros2.messages.serialize import encode
from bhd_lerobot.ros2.messages.views import JOINT_STATE
from bhd_lerobot.ros2.robots.plant import Ros2Plant, scan_reader

_JOINTS = ("wheel_left_joint", "wheel_right_joint")
_STOP = (0.0, 0.0)
_NODE_SILENCE_S = 0.5  # of topics at 20 Hz
_SCAN_SILENCE_S = 1.0  # of scans at 5 Hz


@dataclass(frozen=True)
class WheelReader:
    """Angles [rad] and speeds [rad/s] of the wheels; turtlebot3_node has the speeds in m/s."""

    wheel_radius: float
    width: int = 4

    def read(self, message: Any) -> NDArray[np.float64]:
        """Return the angles and then the speeds, shape (4,)."""
        names = list(message.name)
        missing = [joint for joint in _JOINTS if joint not in names]
        if missing or len(message.position) < len(names) or len(message.velocity) < len(names):
            raise DatasetError(
                f"it has positions and velocities of {', '.join(names) or 'no joint'}; needed: {', '.join(_JOINTS)}"
            )
        order = [names.index(joint) for joint in _JOINTS]
        return np.concatenate([message.position[order], message.velocity[order] / self.wheel_radius])


@dataclass(frozen=True)
class GyroReader:
    """The three rates of a gyroscope [rad/s]."""

    width: int = 3

    def read(self, message: Any) -> NDArray[np.float64]:
        """Return the rates, shape (3,)."""
        rate = message.angular_velocity
        return np.array([rate.x, rate.y, rate.z])


@dataclass(frozen=True)
class TwistWriter:
    """A twist, stamped since Jazzy."""

    stamped: bool
    width: int = 2

    @property
    def msgtype(self) -> str:
        """The type of its messages."""
        return (TwistPart if self.stamped else BareTwistPart).msgtype

    def encode(self, features: NDArray[np.float64], stamp_ns: int) -> bytes:
        """Return the message of a forward speed [m/s] and a yaw rate [rad/s]."""
        tree = twist_tree(features[None])
        return encode(
            self.msgtype, {"header": header(np.array([stamp_ns])), "twist": tree} if self.stamped else tree, 1
        )[0]


class BasePlant(Ros2Plant):
    """A base with the topics of a TurtleBot3: ``/joint_states``, ``/scan``, by option ``/imu``; ``/cmd_vel``.

    The robot's node continues with its last command for ever: the stop is sent when commands cease.

    Args:
        config: the robot's configuration.
        body: its hardware.
    """

    takes = "twist"
    command_hz = 50.0
    usual_latency_s = 0.3
    moves = 0.05  # [m/s] of a wheel

    def __init__(self, config: Any, body: MobileBase) -> None:
        if body.lidar is None:
            raise AssertionError(f"{body.name} has no lidar; the configuration has checked that.")
        beams = config.beams
        self._beams, self._has_gyro = beams, config.imu
        self._half_track, self._wheel_radius = body.drive.wheel_separation / 2, body.drive.wheel_radius
        node_silence = max(_NODE_SILENCE_S, config.ros2.silent_s)
        writer = TwistWriter(config.ros2.distro != "humble")
        inputs = [
            InputSpec("/joint_states", JOINT_STATE, WheelReader(body.drive.wheel_radius), SENSOR_DATA, node_silence),
            InputSpec(
                "/scan",
                ScanPart.msgtype,
                scan_reader(config.ros2, "/scan", body.lidar, beams),
                SENSOR_DATA,
                max(_SCAN_SILENCE_S, config.ros2.silent_s),
            ),
        ]
        if config.imu:
            inputs.append(InputSpec("/imu", GyroPart.msgtype, GyroReader(), SENSOR_DATA, node_silence))
        other = "humble" if writer.stamped else "jazzy"
        remedy = f"Set --robot.ros2.distro={other}."
        output = OutputSpec("/cmd_vel", writer.msgtype, writer, remedy=remedy, stop=_STOP)
        super().__init__(body.name, config, tuple(inputs), (output,))

    def commanded(self, ctrl: NDArray[np.float64]) -> float:
        """Return the speed of the faster wheel [m/s]."""
        return abs(float(ctrl[0, 0])) + abs(float(ctrl[0, 1])) * self._half_track

    def moved(self, out: PlantReading) -> float:
        """Return the speed of the faster wheel [m/s]."""
        return float(np.abs(out.velocity[0]).max()) * self._wheel_radius

    def read_parts(self, state: Any, out: PlantReading) -> None:
        """Write the wheels, the scan and the gyroscope into `out`."""
        wheels = self.numbers(state, 0)
        out.position[0], out.velocity[0] = wheels[:2], wheels[2:]
        out.sensors[0, : self._beams] = self.numbers(state, 1)
        if self._has_gyro:
            out.sensors[0, self._beams :] = self.numbers(state, 2)
        measured = state["measured_ns"]
        if out.stamp_ns is not None:
            out.stamp_ns[0] = measured[0]
        out.sensors_ns[0] = measured[1:].min()
