"""The topics of a TurtleBot3, as `turtlebot3_node`, its lidar's driver and `robot_state_publisher` have them.

Different from the real ones: the IMU has no orientation and no acceleration, the battery is always full, and the robot
stops by itself when no command comes for `command_timeout_s`, where a real one continues with the last.
"""

import math

import numpy as np

from bhd_lerobot.bodies.body import Drive, LidarSpec
from bhd_lerobot.control.messages import NANOSECONDS
from bhd_lerobot.robots.host.realtime import LiveHost
from bhd_lerobot.ros2.live.network import LATCHED, Qos
from bhd_lerobot.ros2.live.node import Node
from bhd_lerobot.ros2.messages import views
from bhd_lerobot.ros2.messages.base import OdometryPart, ScanPart
from bhd_lerobot.ros2.messages.parts import FieldsPart, Frames, header
from bhd_lerobot.ros2.messages.serialize import encode
from bhd_lerobot.ros2.messages.split import gyro_message
from bhd_lerobot.ros2.messages.table import GYRO, IMU_TYPE, JOINTS, ODOMETRY, TWIST, joint_columns
from bhd_lerobot.ros2.serve.server import Output, State, Topics

NODE_HZ = 20  # of turtlebot3_node's timer
_BATTERY = "sensor_msgs/msg/BatteryState"
_VOLTAGE, _CAPACITY = 11.1, 1.8  # [V], [A h], ROBOTIS e-Manual: LiPo, 11.1 V, 1800 mAh
_LIPO, _GOOD, _FULL = 3, 1, 4  # BatteryState's constants: technology, health, supply status
_POLL_NS = 1_000_000  # between two looks for a scan that is due


class BaseTopics(Topics):
    """The topics of a base with a scanner.

    Args:
        host: the robot, with odometry and a gyroscope in its observation.
    """

    def __init__(self, host: LiveHost, node: Node, view: views.RobotView) -> None:
        body = host.body
        lidar = body.need(LidarSpec)
        self._host, self._view, self._drive = host, view, body.need(Drive)
        beams = host.config.beams
        names = list(host.sensed_names)
        self._gyro = [names.index(name) for name in GYRO]
        self._ranges = slice(names.index("scan_000.pos"), names.index("scan_000.pos") + beams)
        self._scan_part = ScanPart("/scan", tuple(names[self._ranges]), lidar=lidar)
        self._odometry_part = OdometryPart("/odom", (*TWIST, *ODOMETRY))
        self._gyro_part = FieldsPart("/imu", GYRO, **gyro_message())
        self._wheel_part = FieldsPart("/joint_states", joint_columns(self._drive.joints), JOINTS, frame="base_link")
        self._scan_period_ns = NANOSECONDS // lidar.rate_hz
        self._scanned_ns = 0  # when the last scan that was published was taken [ns]
        self._scan_due_ns = 0
        self._odometry = node.publisher("/odom", OdometryPart.msgtype)
        self._imu = node.publisher("/imu", IMU_TYPE)
        self._joints = node.publisher("/joint_states", JOINTS)
        self._battery = node.publisher("/battery_state", _BATTERY)
        self._transforms = node.publisher("/tf", views.TF, Qos(100))
        self._static = node.publisher("/tf_static", views.TF, LATCHED)
        self._scan = node.publisher("/scan", ScanPart.msgtype)  # reliable: it serves both kinds of subscription
        for message in views.static_transforms(view.frames, State.of(host).stamp_ns):
            self._static.send(message)
        self.outputs = [Output(NODE_HZ, self._publish)]

    def _publish(self, state: State) -> None:
        robot, observation, frames = state.robot, state.row["observation"], state.frames
        moved = np.concatenate([observation[:, :2], robot.odometry], axis=1)
        angles, speeds = robot.joint_positions, robot.joint_velocities * self._drive.wheel_radius
        self._odometry.send(self._odometry_part.encode(frames, moved)[0])
        self._imu.send(self._gyro_part.encode(frames, observation[:, self._gyro])[0])
        self._joints.send(self._wheel_part.encode(frames, np.concatenate([angles, speeds], axis=1))[0])
        battery = {
            "header": header(state.stamps),
            **{"voltage": _VOLTAGE, "temperature": math.nan, "current": math.nan, "charge": math.nan},
            **{"capacity": math.nan, "design_capacity": _CAPACITY, "percentage": 1.0, "present": True},
            **{"power_supply_status": _FULL, "power_supply_health": _GOOD, "power_supply_technology": _LIPO},
        }
        self._battery.send(encode(_BATTERY, battery, 1)[0])
        self._transforms.send(views.base_transforms(self._odometry_part, frames, moved)[0])
        motion = views.Motion(dict(zip((f"{joint}_joint" for joint in self._drive.joints), angles.T, strict=True)))
        for message in views.moving_transforms(self._view, frames, motion):
            self._transforms.send(message)

    def poll(self, now_ns: int) -> int:
        """Publish a scan that was taken; return when the next one is due [ns]."""
        if now_ns < self._scan_due_ns:
            return self._scan_due_ns
        state = State.of(self._host)
        taken = int(state.row["sensed_ns"] - state.row["oldest_ns"])
        if taken - self._scanned_ns > self._scan_period_ns // 2:
            self._scanned_ns = taken
            stamps = state.stamps - int(state.row["oldest_ns"])
            ranges = state.row["observation"][:, self._ranges]
            self._scan.send(self._scan_part.encode(Frames(0, np.zeros(1, np.int64), stamps), ranges)[0])
        self._scan_due_ns = max(now_ns + _POLL_NS, self._scanned_ns + self._scan_period_ns)
        return self._scan_due_ns
