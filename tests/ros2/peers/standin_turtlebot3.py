"""A stand-in for a real TurtleBot3 Burger: its nodes' topics, types, frames, rates and QoS, in a room with pillars.

As the real one does, it goes on with its last command for ever, takes commands in whole hundredths of m/s and rad/s,
gives wheel positions that are one cycle old, and stamps a scan with the time of its first beam while it publishes it
after its last.

Faults are named by topic, without its slash: scan, odom, tf, imu, joint_states, battery_state, or all. Times count from
the start [s]; an option may be given several times.
"""

import json
import math
import time
from collections.abc import Callable
from typing import Any

import node as peer
import numpy as np
from faults import Outlet, add_faults, at
from geometry_msgs.msg import TransformStamped, TwistStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.qos import QoSDurabilityPolicy, QoSProfile, qos_profile_sensor_data
from room import LIDAR_X, MOST_FORWARD, MOST_TURNING, WHEEL_RADIUS, WHEEL_SEPARATION, Base, Room
from sensor_msgs.msg import BatteryState, Imu, JointState, LaserScan

try:
    from tf2_msgs.msg import TFMessage
except ImportError:  # no wheel has it, and there was no compiler: no /tf
    TFMessage = None

STEP = 0.01  # [s]
CYCLE = 5  # steps between two publications of turtlebot3_node: 20 Hz
TICK = math.tau / 4096  # [rad], of a DYNAMIXEL XL430-W250's encoder
RPM_UNIT = 0.229 * math.tau / 60 * WHEEL_RADIUS  # [m/s], of its velocity
TURN = 0.2  # [s], of the lidar: 5 Hz
OLDEST = 0.2  # [s], what is older by the time it could be published is left out, as after SIGCONT


parser = peer.options(__doc__)
parser.add_argument(
    "--log", help="file for JSON lines: each command, scan, wheel speeds and odometry, and the true pose at 20 Hz"
)
parser.add_argument("--seed", type=int, default=0, help="of all noise")
parser.add_argument("--pose", type=at("X:Y:YAW"), default=(-1.2, -0.6, 0.0), help="where it starts [m, rad]")
parser.add_argument("--open", action="store_true", help="no pillars")
parser.add_argument("--half", type=float, default=2.0, help="half of the room's width [m]")
parser.add_argument("--wait", action="store_true", help="stand still while this process is not scheduled")
fault = add_faults(parser)
fault.add_argument("--clock-offset", type=float, default=0.0, help="[s]")
fault.add_argument("--clock-jump", action="append", default=[], type=at("START:OFFSET"), metavar="START:OFFSET")
args = parser.parse_args()

log_file = open(args.log, "a", buffering=1) if args.log else None  # noqa: SIM115


def record(event: str, monotonic: float, **fields: Any) -> None:
    if log_file is not None:
        log_file.write(json.dumps({"event": event, "monotonic": monotonic} | fields) + "\n")


def quaternion(yaw: float) -> dict[str, float]:
    return {"x": 0.0, "y": 0.0, "z": math.sin(yaw / 2), "w": math.cos(yaw / 2)}


def assign(message: Any, values: dict[str, float]) -> None:
    for name, value in values.items():
        setattr(message, name, value)


class Robot:
    def __init__(self, new_node: Callable[[str], Node]) -> None:
        self.start = time.monotonic()
        self.random = np.random.default_rng(args.seed)
        self.room = Room(args.half, np.zeros((0, 3))) if args.open else Room(args.half)
        self.base = Base(self.room, *args.pose)
        self.now = time.monotonic()  # up to which the robot has moved
        self.steps = 0
        self.wheels = np.zeros(2)  # [rad], left and right
        self.old_wheels = np.zeros(2)  # of the last cycle
        self.odometry = np.zeros(3)  # x, y, yaw [m, rad]
        self.imu_yaw = 0.0
        self.battery = 12.1  # [V]
        self.commands = 0
        self.begin_turn()

        self.outlets: dict[str, Outlet] = {}
        main = new_node("turtlebot3_node")
        drive = new_node("diff_drive_controller")
        lidar = new_node("hlds_laser_publisher")
        self.scan = self.outlet(lidar, "scan", LaserScan, qos=qos_profile_sensor_data, frame="base_scan")
        self.odom = self.outlet(drive, "odom", Odometry, frame="odom")
        self.imu = self.outlet(main, "imu", Imu, frame="imu_link")
        self.joints = self.outlet(main, "joint_states", JointState, frame="base_link")
        self.power = self.outlet(main, "battery_state", BatteryState)
        self.tf = None
        if TFMessage is not None:
            self.tf = self.outlet(drive, "tf", TFMessage, qos=100, frame="odom")
            latched = QoSProfile(depth=1, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL)
            self.publish_fixed_frames(
                new_node("robot_state_publisher").create_publisher(TFMessage, "/tf_static", latched)
            )
        main.create_subscription(TwistStamped, "/cmd_vel", self.on_command, 10)
        main.create_timer(STEP, self.advance)
        main.create_timer(0.1, self.report)

    def outlet(self, node: Node, topic: str, kind: type, **options: Any) -> Outlet:
        outlet = Outlet(args, lambda: self.elapsed, node, f"/{topic}", kind, **options)
        self.outlets[topic] = outlet
        return outlet

    @property
    def elapsed(self) -> float:
        """Time since the start [s]."""
        return self.now - self.start

    def stamp(self, monotonic: float) -> int:
        """Return what the robot's clock shows at a time [ns]."""
        age = time.monotonic() - monotonic
        wrong = args.clock_offset + sum(offset for start, offset in args.clock_jump if monotonic - self.start >= start)
        return time.time_ns() + round((wrong - age) * 1e9)

    def noise(self, deviation: float, *shape: int) -> Any:
        return self.random.normal(0.0, deviation, shape or None)

    # what comes in

    def on_command(self, message: Any) -> None:
        twist = message.twist
        self.commands += 1
        given = twist.linear.x, twist.angular.z
        if all(map(math.isfinite, given)):  # sent to the motors as whole hundredths, cut off
            forward, turning = (math.trunc(value * 100 + math.copysign(1e-9, value)) / 100 for value in given)
            self.base.command = (
                float(np.clip(forward, -MOST_FORWARD, MOST_FORWARD)),
                float(np.clip(turning, -MOST_TURNING, MOST_TURNING)),
            )
        stamp = message.header.stamp.sec + message.header.stamp.nanosec * 1e-9
        record("command", time.monotonic(), given=given, taken=self.base.command, stamp=stamp)

    # what happens

    def advance(self) -> None:
        """Move up to the present, and publish what is due meanwhile."""
        if args.wait:
            self.now = max(self.now, time.monotonic() - OLDEST)
        while self.now + STEP <= time.monotonic():
            self.now += STEP
            self.steps += 1
            driven, turned = self.base.step(STEP)
            slip = 1 + self.noise(0.01, 2)
            half = turned * WHEEL_SEPARATION / 2
            self.wheels += np.array([driven - half, driven + half]) * slip / WHEEL_RADIUS
            self.imu_yaw = math.remainder(self.imu_yaw + turned + self.noise(1e-4), math.tau)
            is_late = time.monotonic() - self.now > OLDEST
            self.turn_lidar(is_late)
            if self.steps % CYCLE == 0:
                self.cycle(is_late)

    def begin_turn(self) -> None:
        self.turn_start = self.now
        self.increment = math.tau / 360
        self.readings = np.full(360, math.nan)
        self.measured = 0

    def turn_lidar(self, is_late: bool) -> None:
        """Measure the beams of one step, and publish when the lidar has turned once."""
        beams = len(self.readings)
        last = min(beams, math.ceil(beams * (self.now - self.turn_start) / TURN - 1e-9))
        angles = self.increment * np.arange(self.measured, last)
        cos, sin = math.cos(self.base.yaw), math.sin(self.base.yaw)
        true = self.room.ranges(self.base.x + LIDAR_X * cos, self.base.y + LIDAR_X * sin, angles + self.base.yaw)
        self.readings[self.measured : last] = true + self.noise(0.01, len(angles))
        self.measured = last
        if last < beams:
            return
        if not is_late:
            self.publish_scan()
        self.begin_turn()

    def publish_scan(self) -> None:
        scan = LaserScan(angle_min=0.0, angle_max=math.tau, angle_increment=self.increment)
        scan.scan_time, scan.time_increment = TURN, TURN / len(self.readings)
        ranges = self.readings
        scan.range_min, scan.range_max = 0.12, 3.5
        ranges = np.where((ranges < scan.range_min) | (ranges > scan.range_max), 0.0, ranges)
        if self.scan.is_nan:
            ranges = np.full(len(ranges), math.nan)
        scan.ranges = ranges.astype(np.float32).tolist()
        scan.intensities = [0.0 if not value > 0 else 200.0 for value in scan.ranges]
        stamp = self.stamp(self.turn_start)
        self.scan.publish(scan, scan.header, stamp)
        shown = [None if math.isnan(value) else value for value in scan.ranges]
        record("scan", self.now, stamp=stamp, first=self.turn_start, ranges=shown)

    def cycle(self, is_late: bool) -> None:
        """Publish what turtlebot3_node and diff_drive_controller publish every 50 ms."""
        stamp, dt = self.stamp(self.now), CYCLE * STEP
        ticks = np.round(self.wheels / TICK) * TICK
        difference, shown, self.old_wheels = ticks - self.old_wheels, self.old_wheels, ticks
        driven = WHEEL_RADIUS * difference.mean()
        turned = WHEEL_RADIUS * (difference[1] - difference[0]) / WHEEL_SEPARATION
        middle = self.odometry[2] + turned / 2
        self.odometry += np.array([driven * math.cos(middle), driven * math.sin(middle), turned])
        self.battery = max(11.0, self.battery - 1e-5)
        base = self.base
        record(
            "pose",
            self.now,
            stamp=stamp,
            pose=[base.x, base.y, base.yaw],
            twist=[base.forward, base.turning],
            odometry=self.odometry.tolist(),
            contacts=base.contacts,
        )
        if is_late:
            return
        odometry = Odometry(child_frame_id="base_footprint")
        pose, twist = odometry.pose.pose, odometry.twist.twist
        pose.position.x, pose.position.y = float(self.odometry[0]), float(self.odometry[1])
        assign(pose.orientation, quaternion(self.odometry[2]))
        twist.linear.x, twist.angular.z = float(driven / dt), float(turned / dt)
        if self.odom.is_nan:
            pose.position.x = pose.position.y = twist.linear.x = twist.angular.z = math.nan
        imu = Imu()
        assign(imu.orientation, quaternion(self.imu_yaw))
        imu.angular_velocity.z = base.turning + self.noise(0.005)
        imu.linear_acceleration.y = base.forward * base.turning + self.noise(0.05)
        imu.linear_acceleration.z = 9.81 + self.noise(0.05)
        if self.imu.is_nan:
            imu.angular_velocity.z = math.nan
        half = base.turning * WHEEL_SEPARATION / 2
        speeds = np.round(np.array([base.forward - half, base.forward + half]) / RPM_UNIT) * RPM_UNIT
        if self.joints.is_nan:
            shown = speeds = np.full(2, math.nan)
        joints = JointState(name=["wheel_left_joint", "wheel_right_joint"])
        joints.position, joints.velocity = shown.tolist(), speeds.tolist()
        power = BatteryState(voltage=self.battery, percentage=100 * (self.battery - 11.0) / 1.1, design_capacity=1.8)
        power.present = True
        if self.power.is_nan:
            power.voltage = math.nan
        self.power.publish(power, power.header, stamp)
        self.imu.publish(imu, imu.header, stamp)
        self.joints.publish(joints, joints.header, stamp)
        record("joints", self.now, stamp=stamp, speeds=speeds.tolist())
        self.odom.publish(odometry, odometry.header, stamp)
        if self.tf is not None:
            transform = TransformStamped(child_frame_id="base_footprint")
            transform.transform.translation.x, transform.transform.translation.y = pose.position.x, pose.position.y
            transform.transform.rotation = pose.orientation
            self.tf.publish(TFMessage(transforms=[transform]), transform.header, stamp)

    def publish_fixed_frames(self, publisher: Any) -> None:
        frames = []
        for parent, child, x, z in (
            ("base_footprint", "base_link", 0.0, 0.010),
            ("base_link", "imu_link", -0.032, 0.068),
            ("base_link", "base_scan", LIDAR_X, 0.172),
        ):
            frame = TransformStamped(child_frame_id=child)
            frame.header.frame_id = parent
            frame.transform.translation.x, frame.transform.translation.z = x, z
            frames.append(frame)
        publisher.publish(TFMessage(transforms=frames))
        self.fixed_frames = publisher

    def report(self) -> None:
        base = self.base
        peer.log(
            "report",
            published={topic: outlet.count for topic, outlet in self.outlets.items()},
            commands=self.commands,
            command=base.command,
            pose=[base.x, base.y, base.yaw],
            twist=[base.forward, base.turning],
            clearance=self.room.clearance(base.x, base.y),
            contacts=base.contacts,
        )


if __name__ == "__main__":
    peer.run(lambda new_node: Robot(new_node).report, args.seconds)
