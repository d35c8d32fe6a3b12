"""A stand-in for the UR driver and its robot: joint states, speed scaling, safety mode, two command topics.

As there, joints come in an order of their own in /joint_states and are to be matched by name, positions go to
/forward_position_controller/commands in the order of the arm, one of the two controllers is active (--active), and a
trajectory's time passes as fast as the speed scaling says. The robot follows within limits of rate and acceleration.

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
from faults import Outlet, add_faults, at
from rclpy.node import Node
from rclpy.qos import QoSDurabilityPolicy, QoSProfile
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64, Float64MultiArray
from trajectory_msgs.msg import JointTrajectory

try:
    from ur_dashboard_msgs.msg import SafetyMode
except ImportError:  # no wheel has it, and there was no compiler: no safety mode
    SafetyMode = None

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
JOINTS = tuple(f"{joint}_joint" for joint in JOINTS)
SHOWN = (1, 2, 3, 4, 5, 0)  # the order of /joint_states
HOME = (0.0, -math.pi / 2, math.pi / 2, -math.pi / 2, -math.pi / 2, 0.0)  # [rad]
MOST_VELOCITY = math.pi  # [rad/s], the UR5's data sheet
STATE_HZ = 100.0  # of the speed scaling
NORMAL, PROTECTIVE_STOP = 1, 3
FORWARD, SCALED = "forward_position_controller", "scaled_joint_trajectory_controller"

parser = peer.options(__doc__)
parser.add_argument("--hz", type=float, default=125.0, help="of /joint_states: 125 of a UR5, 500 of a UR5e [Hz]")
parser.add_argument("--active", choices=(FORWARD, SCALED), default=SCALED)
parser.add_argument(
    "--log", help="file for JSON lines: each command, and at each tick the true and the wanted positions"
)
parser.add_argument("--noise", type=float, default=2e-5, help="of the encoders [rad]")
parser.add_argument("--seed", type=int, default=0)
parser.add_argument("--acceleration", type=float, default=15.0, help="limit of each joint [rad/s^2], an estimate")
parser.add_argument("--velocity", type=float, default=MOST_VELOCITY, help="limit of each joint [rad/s]")
parser.add_argument("--most-jump", type=float, default=math.inf, help="a farther position is a protective stop [rad]")
fault = add_faults(parser)
fault.add_argument("--scaling", action="append", default=[], type=at("START:PERCENT"), metavar="START:PERCENT")
fault.add_argument("--safety", action="append", default=[], type=at("START:MODE"), metavar="START:MODE")
fault.add_argument("--on-usr1", choices=("scaling", "safety", "silence"), help="what happens on SIGUSR1")
fault.add_argument("--value", type=float, default=0.0, help="the percentage or the mode of that")
args = parser.parse_args()
log_file = open(args.log, "w", buffering=1) if args.log else None  # noqa: SIM115


def record(event: str, **fields: Any) -> None:
    if log_file is not None:
        log_file.write(json.dumps({"event": event, "monotonic": time.monotonic()} | fields) + "\n")


class Trajectory:
    """Positions over time, cubic where the points have velocities and linear elsewhere."""

    def __init__(self, message: JointTrajectory, start: np.ndarray) -> None:
        order = [message.joint_names.index(joint) for joint in JOINTS]
        points = message.points
        times = [point.time_from_start.sec + point.time_from_start.nanosec * 1e-9 for point in points]
        if list(times) != sorted(set(times)) or times[0] < 0:
            raise ValueError(f"the times {times} do not increase")
        positions = [np.array(point.positions)[order] for point in points]
        velocities = [np.array(point.velocities)[order] if len(point.velocities) else None for point in points]
        if not np.isfinite(positions).all():
            raise ValueError("a position is not finite")
        if times[0] > 0:
            first = None if velocities[0] is None else np.zeros(6)
            times, positions, velocities = [0.0, *times], [start, *positions], [first, *velocities]
        self.times, self.positions, self.velocities = times, positions, velocities

    def at(self, moment: float) -> np.ndarray:
        """Return the positions at a time since the start [s]."""
        index = int(np.searchsorted(self.times, moment, side="right"))
        if index >= len(self.times):
            return self.positions[-1]
        before, after = self.times[index - 1], self.times[index]
        length, part = after - before, (moment - before) / (after - before)
        p0, p1 = self.positions[index - 1], self.positions[index]
        v0, v1 = self.velocities[index - 1], self.velocities[index]
        if v0 is None or v1 is None:
            return p0 + part * (p1 - p0)
        square, cube = part**2, part**3
        return (
            (2 * cube - 3 * square + 1) * p0
            + (cube - 2 * square + part) * length * v0
            + (3 * square - 2 * cube) * p1
            + (cube - square) * length * v1
        )


class Arm:
    def __init__(self, new_node: Callable[[str], Node]) -> None:
        self.random = np.random.default_rng(args.seed)
        self.start = self.now = time.monotonic()
        self.q = np.array(HOME)
        self.v = np.zeros(6)
        self.wanted = self.q.copy()
        self.trajectory: Trajectory | None = None
        self.trajectory_time = 0.0
        self.scaling = 100.0  # [percent]
        self.mode = NORMAL
        self.commands = self.refused = 0

        clock = self.elapsed
        states = new_node("joint_state_broadcaster")
        self.joint_states = Outlet(args, clock, states, "/joint_states", JointState, frame="base_link")
        speed = new_node("speed_scaling_state_broadcaster")
        self.speed = Outlet(args, clock, speed, "/speed_scaling_state_broadcaster/speed_scaling", Float64)
        forward, scaled = new_node(FORWARD), new_node(SCALED)
        forward.create_subscription(Float64MultiArray, f"/{FORWARD}/commands", self.on_positions, 10)
        scaled.create_subscription(JointTrajectory, f"/{SCALED}/joint_trajectory", self.on_trajectory, 10)
        self.safety = None
        if SafetyMode is not None:
            latched = QoSProfile(depth=1, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL)
            status = new_node("io_and_status_controller")
            self.safety = status.create_publisher(SafetyMode, "/io_and_status_controller/safety_mode", latched)
            self.safety.publish(SafetyMode(mode=self.mode))
        signal.signal(signal.SIGUSR1, self.on_usr1)
        states.create_timer(1 / args.hz, self.advance)
        speed.create_timer(1 / STATE_HZ, self.publish_speed)
        states.create_timer(1.0, self.report)

    def elapsed(self) -> float:
        """Time since the start [s]."""
        return self.now - self.start

    # what comes in

    def on_usr1(self, *_: object) -> None:
        if args.on_usr1 == "silence":
            self.joint_states.gaps.append((0.0, math.inf))
        elif args.on_usr1 == "scaling":
            args.scaling.append((self.elapsed(), args.value))
        else:
            self.set_mode(int(args.value))

    def on_positions(self, message: Float64MultiArray) -> None:
        given = np.array(message.data)
        if args.active != FORWARD:
            return self.refuse("positions", f"{FORWARD} is not active")
        if given.shape != (6,) or not np.isfinite(given).all():
            return self.refuse("positions", f"{given.tolist()} are not 6 finite positions")
        self.take("positions", given=given.tolist())
        if np.abs(given - self.wanted).max() > args.most_jump:
            self.set_mode(PROTECTIVE_STOP)
        self.wanted = given
        return None

    def on_trajectory(self, message: JointTrajectory) -> None:
        if args.active != SCALED:
            return self.refuse("trajectory", f"{SCALED} is not active")
        if sorted(message.joint_names) != sorted(JOINTS):
            return self.refuse("trajectory", f"{list(message.joint_names)} are not the arm's joints")
        if not message.points:
            self.trajectory, self.wanted = None, self.q.copy()
            return self.take("trajectory", points=0)
        try:
            trajectory = Trajectory(message, self.wanted)
        except (ValueError, IndexError) as error:
            return self.refuse("trajectory", str(error))
        self.trajectory, self.trajectory_time = trajectory, 0.0
        return self.take("trajectory", points=len(message.points), end=trajectory.positions[-1].tolist())

    def take(self, event: str, **fields: Any) -> None:
        self.commands += 1
        record(event, **fields)

    def refuse(self, event: str, why: str) -> None:
        self.refused += 1
        record(event, refused=why)
        peer.log("refused", what=event, why=why)

    def set_mode(self, mode: int) -> None:
        if mode != self.mode:
            self.mode = mode
            peer.log("safety_mode", mode=mode)
            record("safety_mode", mode=mode)
            if self.safety is not None:
                self.safety.publish(SafetyMode(mode=mode))

    # what happens

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
        self.scaling = next(
            (value for start, value in sorted(args.scaling, reverse=True) if start <= self.elapsed()), 100
        )
        for start, mode in sorted(args.safety):
            if self.elapsed() - step < start <= self.elapsed():
                self.set_mode(int(mode))
        if self.mode > 2:  # neither normal nor reduced
            self.scaling = 0.0
        fraction = self.scaling / 100
        if self.trajectory is not None:
            self.trajectory_time += step * fraction
            self.wanted = self.trajectory.at(self.trajectory_time)
        velocity = (self.wanted - self.q) / step
        # as fast as still leaves room to stop
        limit = np.minimum(args.velocity * fraction, np.sqrt(2 * args.acceleration * np.abs(self.wanted - self.q)))
        velocity = np.clip(velocity, -limit, limit)
        most = args.acceleration * step
        self.v += np.clip(velocity - self.v, -most, most)
        self.q = self.q + self.v * step

    def publish(self) -> None:
        positions = self.q + self.random.normal(0.0, args.noise, 6)
        velocities, efforts = self.v, 0.1 * np.cos(self.q)  # [A] of current, as the driver's
        if self.joint_states.is_nan:
            positions = velocities = np.full(6, math.nan)
        message = JointState(name=[JOINTS[index] for index in SHOWN])
        message.position = [float(positions[index]) for index in SHOWN]
        message.velocity = [float(velocities[index]) for index in SHOWN]
        message.effort = [float(efforts[index]) for index in SHOWN]
        stamp = time.time_ns()
        self.joint_states.publish(message, message.header, stamp)
        if log_file is not None:
            record("state", stamp=stamp, position=self.q.tolist(), wanted=self.wanted.tolist(), scaling=self.scaling)

    def publish_speed(self) -> None:
        self.speed.publish(Float64(data=math.nan if self.speed.is_nan else float(self.scaling)))

    def report(self) -> None:
        peer.log(
            "report",
            states=self.joint_states.count,
            commands=self.commands,
            refused=self.refused,
            position=self.q.tolist(),
            velocity=self.v.tolist(),
            wanted=self.wanted.tolist(),
            scaling=self.scaling,
            mode=self.mode,
        )


if __name__ == "__main__":
    peer.run(lambda new_node: Arm(new_node).report, args.seconds)
