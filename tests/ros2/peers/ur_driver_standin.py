"""A stand-in for the UR driver and its robot: joint states, speed scaling, safety mode, and a command topic.

As there, joints come in an order of their own in /joint_states and are to be matched by name, and positions go to
/forward_position_controller/commands in the order of the arm. The robot follows within limits of rate and acceleration.

Faults are named by topic, without its first slash, or all. Times count from the start [s].
"""

import json
import math
import signal
import time
from collections.abc import Callable
from typing import Any

import node as peer
import numpy as np
from faults import Outlet, add_faults
from rclpy.node import Node
from rclpy.qos import QoSDurabilityPolicy, QoSProfile
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64, Float64MultiArray

try:
    from ur_dashboard_msgs.msg import SafetyMode
except ImportError:  # no wheel has it, and there was no compiler: no safety mode
    SafetyMode = None

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
JOINTS = tuple(f"{joint}_joint" for joint in JOINTS)
SHOWN = (1, 2, 3, 4, 5, 0)  # the order of /joint_states
HOME = (0.0, -math.pi / 2, math.pi / 2, -math.pi / 2, -math.pi / 2, 0.0)  # [rad]
MOST_VELOCITY = math.pi  # [rad/s], the UR5's data sheet
MOST_ACCELERATION = 15.0  # [rad/s^2] of each joint, an estimate
NOISE = 2e-5  # of the encoders [rad]
STATE_HZ = 100.0  # of the speed scaling
NORMAL = 1
FORWARD = "forward_position_controller"

parser = peer.options(__doc__)
parser.add_argument("--hz", type=float, default=125.0, help="of /joint_states: 125 of a UR5, 500 of a UR5e [Hz]")
parser.add_argument(
    "--log", help="file for JSON lines: each command, and at each tick the true and the wanted positions"
)
fault = add_faults(parser)
fault.add_argument(
    "--on-usr1",
    action="append",
    default=[],
    metavar="scaling:PERCENT, safety:MODE or silence",
    help="what happens on SIGUSR1; of several, one each time, in this order",
)
args = parser.parse_args()
log_file = open(args.log, "w", buffering=1) if args.log else None  # noqa: SIM115


def record(event: str, **fields: Any) -> None:
    if log_file is not None:
        log_file.write(json.dumps({"event": event, "monotonic": time.monotonic()} | fields) + "\n")


class Arm:
    def __init__(self, new_node: Callable[[str], Node]) -> None:
        self.random = np.random.default_rng(0)
        self.start = self.now = time.monotonic()
        self.wall = time.time() - self.start  # of the wall clock's zero [s]
        self.q = np.array(HOME)
        self.v = np.zeros(6)
        self.wanted = self.q.copy()
        self.scaling = 100.0  # [percent]
        self.mode = NORMAL

        states = new_node("joint_state_broadcaster")
        self.joint_states = Outlet(args, self.elapsed, states, "/joint_states", JointState, frame="base_link")
        speed = new_node("speed_scaling_state_broadcaster")
        self.speed = Outlet(args, self.elapsed, speed, "/speed_scaling_state_broadcaster/speed_scaling", Float64)
        new_node(FORWARD).create_subscription(Float64MultiArray, f"/{FORWARD}/commands", self.on_positions, 10)
        self.safety = None
        if SafetyMode is not None:
            latched = QoSProfile(depth=1, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL)
            status = new_node("io_and_status_controller")
            self.safety = status.create_publisher(SafetyMode, "/io_and_status_controller/safety_mode", latched)
            self.safety.publish(SafetyMode(mode=self.mode))
        signal.signal(signal.SIGUSR1, self.on_usr1)
        states.create_timer(1 / args.hz, self.advance)
        speed.create_timer(1 / STATE_HZ, lambda: self.speed.publish(Float64(data=self.scaling)))
        states.create_timer(0.1, self.report)

    def elapsed(self) -> float:
        """Time since the start [s]."""
        return self.now - self.start

    def on_usr1(self, *_: object) -> None:
        what, _, value = args.on_usr1.pop(0).partition(":")
        if what == "silence":
            self.joint_states.gaps.append((0.0, math.inf))
        elif what == "scaling":
            self.scaling = float(value)
        else:
            self.mode = int(value)
            if self.safety is not None:
                self.safety.publish(SafetyMode(mode=self.mode))

    def on_positions(self, message: Float64MultiArray) -> None:
        self.wanted = np.array(message.data)
        record("positions", given=self.wanted.tolist())

    def advance(self) -> None:
        """Move up to the present, in steps of one cycle, and publish the last of them."""
        step = 1 / args.hz
        moved = False
        while self.now + step <= time.monotonic():
            self.now += step
            self.move(step)
            moved = True
        if moved:
            self.publish()

    def move(self, step: float) -> None:
        fraction = 0.0 if self.mode > 2 else self.scaling / 100  # neither normal nor reduced
        velocity = (self.wanted - self.q) / step
        # as fast as still leaves room to stop
        room = np.sqrt(2 * MOST_ACCELERATION * np.abs(self.wanted - self.q))
        limit = np.minimum(MOST_VELOCITY * fraction, room)
        velocity = np.clip(velocity, -limit, limit)
        most = MOST_ACCELERATION * step
        self.v += np.clip(velocity - self.v, -most, most)
        self.q = self.q + self.v * step

    def publish(self) -> None:
        positions = self.q + self.random.normal(0.0, NOISE, 6)
        velocities, efforts = self.v, 0.1 * np.cos(self.q)  # [A] of current, as the driver's
        if self.joint_states.is_nan:
            positions = velocities = np.full(6, math.nan)
        message = JointState(name=[JOINTS[index] for index in SHOWN])
        message.position = [float(positions[index]) for index in SHOWN]
        message.velocity = [float(velocities[index]) for index in SHOWN]
        message.effort = [float(efforts[index]) for index in SHOWN]
        stamp = round((self.wall + self.now) * 1e9)  # when it was there, however late this runs
        self.joint_states.publish(message, message.header, stamp)
        record("state", stamp=stamp, position=self.q.tolist(), wanted=self.wanted.tolist())

    def report(self) -> None:
        peer.log("report", states=self.joint_states.count, position=self.q.tolist(), mode=self.mode)


if __name__ == "__main__":
    peer.run(lambda new_node: Arm(new_node).report, args.seconds)
