"""What is physically there, as data: joints, actuators, sensors, limits and rates of a robot, and the shapes around it.

Nothing here computes and nothing here knows a physics engine. Every other room that needs a number about hardware reads
it from a `Body`, so that a simulated and a real robot are limited by the same figures.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.errors import ConfigError

_NO_JERK_LIMIT = 1e12
_ROTATION_ERROR = 1e-6  # how far the rows of a rotation may be from orthonormal


def _is_count(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value > 0


@dataclass(frozen=True)
class Rates:
    """The three rates of a run [Hz], from the fastest to the slowest.

    Attributes:
        physics_hz: physics steps a second.
        control_hz: cerebellum ticks a second.
        fps: observations and actions a second, which is also the frame rate of a dataset.
    """

    physics_hz: int
    control_hz: int
    fps: int

    def __post_init__(self) -> None:
        for name, value in (("physics_hz", self.physics_hz), ("control_hz", self.control_hz), ("fps", self.fps)):
            if not _is_count(value):
                raise ConfigError(f"{name} is {value!r}; it must be a positive whole number of Hz.")
        for slow_name, slow, fast_name, fast in (
            ("control_hz", self.control_hz, "physics_hz", self.physics_hz),
            ("fps", self.fps, "control_hz", self.control_hz),
        ):
            if fast % slow:
                near = sorted((rate for rate in range(1, fast + 1) if fast % rate == 0), key=lambda r: abs(r - slow))
                raise ConfigError(
                    f"{slow_name} is {slow} Hz, which does not divide {fast_name} = {fast} Hz. In lockstep every rate "
                    f"divides the one above it; the nearest valid values of {slow_name}: "
                    f"{', '.join(map(str, sorted(near[:4])))}."
                )

    @property
    def steps_per_tick(self) -> int:
        """Physics steps in one control tick."""
        return self.physics_hz // self.control_hz

    @property
    def ticks_per_frame(self) -> int:
        """Control ticks in one frame."""
        return self.control_hz // self.fps


@dataclass(frozen=True, kw_only=True)
class Limits:
    """Limits of commands, one value for each command dimension, which is a velocity or a position.

    Attributes:
        names: the command dimensions, in the order of the action features.
        velocity: largest magnitude of a velocity, or speed of a position [m/s or rad/s].
        acceleration: largest change of it per second in normal motion [m/s^2 or rad/s^2].
        stop_deceleration: largest change of it per second when the robot has to stop, on an emergency stop for example
            [m/s^2 or rad/s^2].
        command_timeout_s: age at which the last command is no longer trusted and the robot stops [s].
        jerk: largest change of the acceleration in normal motion, per second [m/s^3 or rad/s^3]; if left out, what
            takes the acceleration from nothing to its limit in a seventh of a second: with more a TurtleBot3 rocks on
            its caster, and its true speed goes more than 5 % beyond what it is commanded.
        lower: smallest position [rad, or m for a gripper]; infinite for a velocity, as are all that follow.
        upper: largest position [rad or m].
        stop_jerk: largest change of the acceleration when a position has to stop at once [rad/s^3 or m/s^3].
        effort: largest torque or force of a position's servo [N m or N].
        setpoint_jerk: largest change of the acceleration while positions are followed [rad/s^3 or m/s^3]; 20 times
            `jerk` if left out. A smaller one follows a stream later and overshoots more where it ends.
    """

    names: tuple[str, ...]
    velocity: tuple[float, ...]
    acceleration: tuple[float, ...]
    stop_deceleration: tuple[float, ...]
    command_timeout_s: float
    jerk: tuple[float, ...] = ()
    lower: tuple[float, ...] = ()
    upper: tuple[float, ...] = ()
    stop_jerk: tuple[float, ...] = ()
    effort: tuple[float, ...] = ()
    setpoint_jerk: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        n = len(self.names)
        unlimited = (math.inf,) * n
        position = bool(self.lower)
        for name, default in (
            ("jerk", tuple(7.0 * value for value in self.acceleration)),
            ("lower", (-math.inf,) * n),
            *((name, unlimited) for name in ("upper", "stop_jerk", "effort")),
        ):
            if not getattr(self, name):
                object.__setattr__(self, name, default)
        if not self.setpoint_jerk:
            jerk = tuple(20.0 * value for value in self.jerk) if position else unlimited
            object.__setattr__(self, "setpoint_jerk", jerk)
        if not len(self.lower) == len(self.upper) == n:
            raise ConfigError(f"lower and upper need {n} numbers each.")
        for name in ("velocity", "acceleration", "stop_deceleration", "jerk", "stop_jerk", "effort", "setpoint_jerk"):
            values, may_be_infinite = getattr(self, name), name in ("stop_jerk", "effort", "setpoint_jerk")
            if len(values) != n or not all(
                0 < value < math.inf or (may_be_infinite and value == math.inf == high)
                for value, high in zip(values, self.upper, strict=True)
            ):
                raise ConfigError(f"{name} is {values}; it needs {n} positive finite numbers.")
        for low, high in zip(self.lower, self.upper, strict=True):
            if not (-math.inf < low < high < math.inf or (low, high) == (-math.inf, math.inf)):
                raise ConfigError(f"lower is {self.lower} and upper is {self.upper}; each range must be finite.")
        if not 0 < self.command_timeout_s < math.inf:
            raise ConfigError(
                f"command_timeout_s is {self.command_timeout_s}; it must be positive and finite. "
                "A time-out of 0 does not mean 'off': the watchdog cannot be turned off."
            )

    def and_then(self, others: "Limits") -> "Limits":
        """Return limits of these commands and of others after them; the shorter of the time-outs counts."""
        joined = {one.name: (*getattr(self, one.name), *getattr(others, one.name)) for one in fields(self)
                  if one.name != "command_timeout_s"}  # fmt: skip
        return Limits(**joined, command_timeout_s=min(self.command_timeout_s, others.command_timeout_s))

    @property
    def bounds(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """The smallest and the largest value of each command, be it a velocity or a position."""
        positions = [math.isfinite(low) for low in self.lower]
        lower = (low if one else -most for one, low, most in zip(positions, self.lower, self.velocity, strict=True))
        upper = (high if one else most for one, high, most in zip(positions, self.upper, self.velocity, strict=True))
        return tuple(lower), tuple(upper)


@dataclass(frozen=True, kw_only=True)
class Drive:
    """Two driven wheels on one axis, each with a velocity servo, and the base that they move.

    A command is the forward speed [m/s] and the yaw rate [rad/s].

    Attributes:
        limits: limits of the commands.
        joints: joint names, left then right.
        actuators: actuator names, left then right.
        wheel_radius: rolling radius [m].
        wheel_separation: distance between the contact points [m].
        max_wheel_speed: largest wheel speed [rad/s].
        max_torque: largest wheel torque [N m].
        servo_gain: torque per speed error of the velocity servo [N m s/rad].
        encoder_ticks: encoder counts in one wheel revolution.
        touch_sensor: name of the contact sensor that counts touches with the scene.
        radius: radius of the vertical cylinder around the root body's origin that holds the whole robot [m].
        height: height of the robot [m].
        outline: rectangles around the middle of the wheel axis that together hold the robot, seen from above: rear,
            front, and half the width of each [m].
        stalled_s: a wheel that turns less than half as far as commanded for so long is blocked [s].
    """

    limits: Limits
    joints: tuple[str, str]
    actuators: tuple[str, str]
    wheel_radius: float
    wheel_separation: float
    max_wheel_speed: float
    max_torque: float
    servo_gain: float
    encoder_ticks: int
    touch_sensor: str = "touch"
    radius: float
    height: float
    outline: tuple[tuple[float, float, float], ...]
    stalled_s: float = 0.3


@dataclass(frozen=True)
class LidarSpec:
    """A planar scanning range finder.

    Attributes:
        site: name of the site it sits on; beam 0 points along the site's x axis, beams run counter-clockwise.
        beams: number of beams in a full turn.
        range_min: shortest range [m]; anything nearer reads `range_min`.
        range_max: longest range [m]; a beam without a return reads `range_max`.
        rate_hz: scans a second.
        noise_std: standard deviation of the Gaussian range noise [m]; 0 turns it off.
        ahead: where the site is, ahead of the wheel axis [m].

    Raises:
        ConfigError: a value is out of range.
    """

    site: str
    beams: int
    range_min: float
    range_max: float
    rate_hz: int
    noise_std: float
    ahead: float = 0.0

    def __post_init__(self) -> None:
        for name, value in (("beams", self.beams), ("rate_hz", self.rate_hz)):
            if not _is_count(value):
                raise ConfigError(f"{name} of the lidar is {value!r}; it must be a positive whole number.")
        if not 0 <= self.range_min < self.range_max < math.inf:
            raise ConfigError(
                f"range_min of the lidar is {self.range_min} m and range_max {self.range_max} m; "
                "0 <= range_min < range_max is needed, both finite."
            )
        if not 0 <= self.noise_std < math.inf:
            raise ConfigError(
                f"noise_std of the lidar is {self.noise_std}; it must be 0 (off) or a positive number of metres."
            )
        if not math.isfinite(self.ahead):
            raise ConfigError(f"ahead of the lidar is {self.ahead}; it must be a finite number of metres.")


@dataclass(frozen=True)
class CameraSpec:
    """A camera of the body.

    Attributes:
        width: image width [px].
        height: image height [px].
    """

    name: str
    width: int
    height: int

    def __post_init__(self) -> None:
        if not (_is_count(self.width) and _is_count(self.height)):
            raise ConfigError(
                f"The image of camera {self.name!r} is {self.width!r} x {self.height!r} px; "
                "both must be positive whole numbers."
            )


OBSTACLE = "obstacle_"
"""What the names of capsules begin with that are no part of the arm."""
HELD = "held"
"""What the names of capsules begin with that stand for what the gripper holds."""
_PAD, _EDGE = 0.02, 0.001  # [m] what is held reaches at least so far to the sides; radius of its edges
_SLIPS = 0.003  # [m] farther out its edges are assumed: it may have slipped down in the fingers


_Three = tuple[float, float, float]


@dataclass(frozen=True)
class Placement:
    """A frame in another one.

    Attributes:
        position: its origin [m].
        rotation: the rows of its rotation matrix.
    """

    position: _Three = (0.0, 0.0, 0.0)
    rotation: tuple[_Three, _Three, _Three] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))

    def __post_init__(self) -> None:
        position, rotation = (np.array(values, np.float64) for values in (self.position, self.rotation))
        if (position.shape, rotation.shape) != ((3,), (3, 3)) or not np.isfinite([*position, *rotation.flat]).all():
            raise ConfigError(
                f"position is {self.position} and rotation {self.rotation}; they need 3 and 3 x 3 finite numbers."
            )
        if np.abs(rotation @ rotation.T - np.eye(3)).max() > _ROTATION_ERROR or np.linalg.det(rotation) < 0.0:
            raise ConfigError(f"{self.rotation} is no rotation: its rows are not orthonormal, or it is mirrored.")

    @classmethod
    def of(cls, matrix: NDArray[np.float64]) -> "Placement":
        """Return the placement of a homogeneous transform, shape (4, 4)."""
        rows: Any = tuple(tuple(row) for row in matrix[:3, :3].tolist())
        return cls(tuple(matrix[:3, 3].tolist()), rows)

    def matrix(self) -> NDArray[np.float64]:
        """Return the homogeneous transform, shape (4, 4)."""
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = self.rotation, self.position
        return matrix


@dataclass(frozen=True)
class Capsule:
    """All points within `radius` of a segment that is fixed to a link of an arm.

    Attributes:
        name: its name.
        frame: the frame of the chain that it is fixed to: 0 is the base frame, i the frame behind joint i.
        start: one end of the segment in that frame [m].
        end: the other end [m].
        radius: [m].
    """

    name: str
    frame: int
    start: _Three
    end: _Three
    radius: float


@dataclass(frozen=True, kw_only=True)
class ArmChain:
    """The geometry of a serial arm: any chain of joints that turn.

    The transform from the base frame to frame 1 is base Rz(q_1) links_1, and that from frame i - 1 to frame i
    Rz(q_i) links_i: joint 1 turns about the z axis of `base`, joint i about that of frame i - 1. The last frame is that
    of the flange, and its transform to the tool frame is `tool`. A chain in the standard Denavit-Hartenberg convention
    is made by `from_dh`, one of a MuJoCo model by `sim.chain.chain_from_mjcf`.

    Attributes:
        joints: joint names, from the base to the flange.
        links: for each joint, where the next frame is in the one that turns with the joint.
        base: the frame that joint 1 turns in, in the base frame.
        tool: the tool frame in the flange frame. Its origin is the tool centre point, its z axis points out of the
            gripper, its y axis from the left to the right finger.
        capsules: what the collision checks take the arm for.
        disjoint: pairs of capsule names whose distance is checked; pairs that cannot meet are left out.
        min_distance: smallest permitted distance between two capsules, and between a capsule and the table [m].
        min_manipulability: below this product of the Jacobian's singular values a posture counts as singular [m^3 with
            six joints or more].
    """

    joints: tuple[str, ...]
    links: tuple[Placement, ...]
    base: Placement = Placement()
    tool: Placement
    capsules: tuple[Capsule, ...]
    disjoint: tuple[tuple[str, str], ...]
    min_distance: float
    min_manipulability: float

    def __post_init__(self) -> None:
        if not self.joints or len(self.joints) != len(self.links):
            raise ConfigError(f"The chain has {len(self.joints)} joints and {len(self.links)} links; one link a joint.")

    @classmethod
    def from_dh(
        cls, joints: tuple[str, ...], a: Sequence[float], d: Sequence[float], alpha: Sequence[float], **others: Any
    ) -> "ArmChain":
        """Return a chain in the standard Denavit-Hartenberg convention, whose links are Tz(d) Tx(a) Rx(alpha).

        Args:
            joints: joint names, from the base to the flange.
            a: link lengths [m].
            d: link offsets [m].
            alpha: link twists [rad].
            others: the other attributes; `tool` may be a position alone.
        """
        if not len(joints) == len(a) == len(d) == len(alpha):
            raise ConfigError(f"There are {len(joints)} joints, {len(a)} a, {len(d)} d and {len(alpha)} alpha.")
        links = []
        for length, offset, twist in zip(a, d, alpha, strict=True):
            # What is exactly 0 or 1 is so in sums, too.
            c, s = (round(value, 15) for value in (math.cos(twist), math.sin(twist)))
            links.append(Placement((length, 0.0, offset), ((1.0, 0.0, 0.0), (0.0, c, -s), (0.0, s, c))))
        tool = others.pop("tool")
        tool = tool if isinstance(tool, Placement) else Placement(tool)
        return cls(joints=joints, links=tuple(links), tool=tool, **others)

    @property
    def dof(self) -> int:
        """How many joints it has."""
        return len(self.joints)

    @property
    def reach(self) -> float:
        """How far the tool centre point can be from the base frame's origin at the most [m]."""
        return sum(math.hypot(*place.position) for place in (self.base, *self.links, self.tool))

    def holding(self, held: Capsule | None) -> "ArmChain":
        """Return the geometry with something in the gripper, whose distances are checked like those of the gripper.

        With its edges: what is held stood on a flat end, whose corners come lower when it is tilted.
        """
        if held is None:
            return self
        tooling = {capsule.name for capsule in self.capsules if capsule.frame == held.frame}
        partners = {one: None for pair in self.disjoint for one in pair if tooling & set(pair) and one not in tooling}
        fingers_way = tuple(row[1] for row in self.tool.rotation)
        parts = (*_edges(held, fingers_way), held)
        pairs = tuple((one, part.name) for one in partners for part in parts)
        return replace(self, capsules=(*self.capsules, *parts), disjoint=(*self.disjoint, *pairs))


def _edges(held: Capsule, fingers_way: tuple[float, ...]) -> list[Capsule]:
    """Return the edges of a square bar along a capsule, with sides along the fingers' way and across it."""
    start, end = np.array(held.start), np.array(held.end)
    way = end - start
    length = float(np.linalg.norm(way))
    if length < _EDGE:
        return []
    along = way / length
    across = np.cross(along, fingers_way)
    size = float(np.linalg.norm(across))
    if size < _EDGE:  # it lies along the fingers' way
        return []
    across /= size
    half, last = max(held.radius, _PAD) + _SLIPS - _EDGE, end + along * (held.radius - _EDGE)
    edges = []
    for number, (x, y) in enumerate(((1, 1), (1, -1), (-1, 1), (-1, -1))):
        offset = half * (x * across + y * np.cross(across, along))
        first, second = (tuple((point + offset).tolist()) for point in (start, last))
        edges.append(Capsule(f"{held.name}_{number}", held.frame, first, second, _EDGE))
    return edges


@dataclass(frozen=True)
class GripperSpec:
    """A gripper that one number moves: its opening, whatever its joints are.

    The opening grows evenly with the joints: two slides of parallel fingers, the hinge of a jaw, or the hinges that
    drive a linkage. Of a jaw it is the length of the arc between the finger tips.

    Attributes:
        joints: names of the one or two joints that the opening is read from, left then right.
        actuator: name of the actuator; its command is the opening [m].
        body: name of the body that palm and fingers belong to.
        tendon: name of the tendon that the actuator pulls; the first of the joints if empty.
        pads: names of the geoms that hold.
        max_opening: largest opening [m].
        widest: narrow side of the widest object that it is given to grasp [m].
        closed: where each joint is when it is closed [m or rad]; 0 if left out.
        opened: where each joint is at the largest opening [m or rad]; equal shares of it if left out.
        pull: length of what the actuator pulls when it is closed, and how much longer that is at the largest opening;
            0 and the largest opening if left out.
    """

    joints: tuple[str, ...]
    actuator: str
    body: str
    tendon: str
    pads: tuple[str, ...]
    max_opening: float
    widest: float
    closed: tuple[float, ...] = ()
    opened: tuple[float, ...] = ()
    pull: tuple[float, float] = ()  # type: ignore[assignment]

    def __post_init__(self) -> None:
        n = len(self.joints)
        for name, default in (
            ("closed", (0.0,) * n),
            ("opened", (self.max_opening / n,) * n),
            ("pull", (0.0, self.max_opening)),
        ):
            if not getattr(self, name):
                object.__setattr__(self, name, default)
        if not 1 <= n <= 2 or not len(self.closed) == len(self.opened) == n:
            raise ConfigError(
                f"The gripper has the joints {self.joints}, which are at {self.closed} when it is closed and at "
                f"{self.opened} when it is open; it needs one or two joints, and a number for each."
            )
        if not self.max_opening > 0 or not all(np.subtract(self.opened, self.closed)) or not self.pull[1]:
            raise ConfigError(
                f"The gripper's largest opening is {self.max_opening} m, and its joints {self.joints} go from "
                f"{self.closed} when it is closed to {self.opened}; it must be positive, and each of them must move."
            )

    @property
    def per_joint(self) -> tuple[float, ...]:
        """By how much the opening grows with each joint [m/m or m/rad]."""
        moves = zip(self.opened, self.closed, strict=True)
        return tuple(self.max_opening / (len(self.joints) * (opened - closed)) for opened, closed in moves)

    @property
    def offset(self) -> float:
        """The opening where its joints are at 0 [m]."""
        return -sum(one * closed for one, closed in zip(self.per_joint, self.closed, strict=True))

    def joints_at(self, opening: float) -> tuple[float, ...]:
        """Return where its joints are at an opening [m]."""
        n = len(self.joints)
        return tuple(closed + opening / (n * one) for closed, one in zip(self.closed, self.per_joint, strict=True))


@dataclass(frozen=True, kw_only=True)
class Handling:
    """How an arm takes things from its table, from above.

    Attributes:
        scale: measures of the objects that it is given, compared with those of the UR5's.
        finger: half the thickness of a finger, and a little room [m].
        palm: from the tool centre point up to where an object would touch the palm [m].
        lowest: the tool centre point above the table when the finger tips are just above it [m].
        travel: height of the tool above the table on free motions: the finger tips stay above every object [m].
        highest: what is taken with the tool centre point higher than this above the table did not stand on it [m].
        lift: height by which it can lift what it has grasped anywhere on its table [m].
        neutral: direction from the right to the left finger, beside that from the base to the tool, when the wrist is
            turned as at home [rad].
        fixed: from the tool centre point to the finger that does not move, along the tool's y axis [m]; None if both
            move.
        hand_over: where a person can take what it holds [m].
    """

    scale: float = 1.0
    finger: float = 0.018
    palm: float = 0.055
    lowest: float = 0.024
    travel: float = 0.22
    highest: float = 0.2
    lift: float = 0.15
    neutral: float = 0.0
    fixed: float | None = None
    hand_over: tuple[float, float, float] = (0.40, -0.40, 0.35)


@dataclass(frozen=True, kw_only=True)
class Workspace:
    """Where tasks put targets and objects, in an arm's base frame: before the arm, over its table.

    Attributes:
        tool: two corners of the box that targets of the tool lie in [m].
        around_home: a posture of a target turns each joint from home by at most this [rad].
        table: two corners of the rectangle that objects stand in [m].
        reach: horizontal distance from the base beyond which a tool that points down does not get [m].
        handling: how things are taken from the table.
    """

    tool: tuple[tuple[float, float, float], tuple[float, float, float]]
    around_home: tuple[float, ...]
    table: tuple[tuple[float, float], tuple[float, float]]
    reach: float
    handling: Handling = Handling()


@dataclass(frozen=True)
class Inertia:
    """What moves as one with a joint of an arm, in the frame of the chain that turns with it.

    Attributes:
        mass: [kg].
        centre: of mass [m].
        about: rotational inertia about the centre of mass, by rows [kg m^2].
        rotor: of the motor, as the joint feels it [kg m^2].
    """

    mass: float
    centre: tuple[float, float, float]
    about: tuple[tuple[float, float, float], ...]
    rotor: float


@dataclass(frozen=True, kw_only=True)
class Arm:
    """An arm, mounted on a table, with or without a gripper.

    The table's top is the plane z = 0 of the chain's base frame. A command is the position of each joint [rad] in the
    chain's order, and then the gripper's opening [m], if there is one. What is said of the gripper here is left out
    without one.

    Attributes:
        limits: limits of the commands, the gripper's last.
        chain: the geometry.
        gripper: the gripper; None if it has none.
        servo_stiffness: torque per position error of each joint's servo [N m/rad]; force per opening error of the
            gripper's, last [N/m].
        servo_damping: torque per speed error of each joint's servo [N m s/rad], and of the gripper's [N s/m].
        actuators: actuator names, the gripper's last.
        actuation: ``"position"``: servos take positions and compensate gravity; ``"torque"``: they take torques.
        brake_damping: torque per speed of each joint's closed brake [N m s/rad]; none if empty. An arm with torque
            motors needs them: no sensor that is wrong moves it while they are closed.
        brake_slip: with which torque a joint slips whose brake has been closed for a while [N m].
        home: the posture that it starts in [rad], and the gripper's opening [m].
        workspace: where tasks put targets and objects.
        payload: largest mass in the gripper [kg].
        load: mass that the gripper is declared to carry, at the tool centre point [kg]: motions are planned with it.
        inertias: of each joint, the gripper at its opening at home as a part of the last; those of the body's MJCF if
            left out, whose joints are then the chain's and the gripper's, each about an axis of its body.
        latency_s: time until a command acts [s]; the reference is led by it, as by the servos' own lag.
        arrived_rad: a joint nearer to its target than this that stands still has arrived [rad]: friction, and what
            the gripper holds, keep soft servos off by a part of it.
        blocked_rad: a joint that is farther than this from its reference does not follow it [rad]; goals end then.
            What the latency accounts for is added to it.
        blocked_s: an arm with such a joint, whose servo gives all it has, is stopped after so long [s].
    """

    limits: Limits
    chain: ArmChain
    gripper: GripperSpec | None
    servo_stiffness: tuple[float, ...]
    servo_damping: tuple[float, ...]
    actuators: tuple[str, ...]
    actuation: Literal["position", "torque"]
    home: tuple[float, ...]
    workspace: Workspace
    payload: float
    load: float = 0.0
    brake_damping: tuple[float, ...] = ()
    brake_slip: tuple[float, ...] = ()
    inertias: tuple[Inertia, ...] = ()
    latency_s: float = 0.0
    arrived_rad: float = 0.002
    blocked_rad: float = 0.1
    blocked_s: float = 0.05

    @property
    def lead_s(self) -> tuple[float, ...]:
        """By how long the commands of each position servo are led, so that it follows without a lag [s]."""
        servos = zip(self.servo_damping, self.servo_stiffness, strict=True)
        return tuple(damping / stiffness + self.latency_s for damping, stiffness in servos)


@dataclass(frozen=True, kw_only=True)
class Body:
    """A robot's hardware: what it is made of. A part that it does not have is None.

    Attributes:
        name: body name, for example ``"turtlebot3_burger"``.
        mjcf: MJCF document of the robot alone, without floor or scene; empty for a robot that is not simulated, whose
            forces and torques are then not known from its motion either.
        root: name of the root body, which carries a free joint if the robot moves.
        drive: the wheels and the base that they move.
        arm: the arm with its gripper; of a body with a drive, too, it is mounted on the base, and its chain begins in
            the root body's frame, on the floor between the wheels.
        lidar: the range finder.
        cameras: the cameras, by name.
        physics_hz: default physics rate [Hz].
        control_hz: default control rate [Hz].
        least_physics_hz: physics rate below which its simulation shakes [Hz].
        least_control_hz: control rate below which its controller takes its own motion for a fault [Hz].
    """

    name: str
    mjcf: str
    root: str
    drive: Drive | None = None
    arm: Arm | None = None
    lidar: LidarSpec | None = None
    cameras: dict[str, CameraSpec] = field(default_factory=dict)
    physics_hz: int = 200
    control_hz: int = 200
    least_physics_hz: int = 1
    least_control_hz: int = 1

    def __post_init__(self) -> None:
        if self.drive is None and self.arm is None:
            raise ConfigError(f"The body {self.name!r} has neither a drive nor an arm; it needs one of them.")
        if self.drive is not None and self.arm is not None and self.arm.actuation != "position":
            raise ConfigError(f"The arm of {self.name!r} is on a base and takes torques; it needs position servos.")

    @cached_property
    def limits(self) -> Limits:
        """Limits of the commands that it takes: the arm's, then the drive's."""
        parts = [part.limits for part in (self.arm, self.drive) if part is not None]
        return parts[0] if len(parts) == 1 else parts[0].and_then(parts[1])

    @property
    def joints(self) -> tuple[str, ...]:
        """What is read of it, in order: the arm's joints, the gripper's opening, and the wheels."""
        arm = self.arm
        of_arm = () if arm is None else (*arm.chain.joints, *(("gripper",) if arm.gripper else ()))
        return (*of_arm, *(self.drive.joints if self.drive is not None else ()))

    @property
    def parts(self) -> Mapping[type, Any]:
        """What it is made of, by the types that tasks and brains name in `needs`."""
        found = (self.drive, self.arm, self.arm and self.arm.gripper, self.lidar)
        return {type(part): part for part in found if part is not None}

    def need[P](self, part: type[P]) -> P:
        """Return a part.

        Raises:
            ConfigError: it does not have it.
        """
        if part not in self.parts:
            raise ConfigError(f"The robot {self.name!r} has no {PARTS[part]}, which is needed here.")
        found: P = self.parts[part]
        return found

    def check_rates(self, rates: Rates, *, is_simulated: bool = True) -> None:
        """Check that the robot can be simulated and controlled at some rates.

        Raises:
            ConfigError: a rate is too low; the message gives the nearest that work.
        """
        least = self.least_control_hz, self.least_physics_hz if is_simulated else 1
        if rates.control_hz >= least[0] and rates.physics_hz >= least[1]:
            return
        most = 4 * max(least[0], rates.control_hz)
        control = range(-(-least[0] // rates.fps) * rates.fps, most + rates.fps, rates.fps)
        pairs = [(hz, -(-max(least[1], rates.physics_hz) // hz) * hz) for hz in control]
        near = min(pairs, key=lambda pair: (pair[1] != rates.physics_hz, abs(pair[0] - rates.control_hz), pair[1]))
        raise ConfigError(
            f"control_hz is {rates.control_hz} and physics_hz is {rates.physics_hz}; the {self.name} needs at least "
            f"{least[0]} and {least[1]} Hz, or it shakes and stops with false faults. The nearest that work at fps = "
            f"{rates.fps}: control_hz = {near[0]}, physics_hz = {near[1]}."
        )


PARTS: Mapping[type, str] = {Drive: "drive", Arm: "arm", GripperSpec: "gripper", LidarSpec: "lidar"}
"""The parts that a task or a brain may need, and what messages call them."""


def without_jerk_limits(body: Body) -> Body:
    """Return a body whose accelerations may change at once when setpoints are followed."""
    drive, arm = body.drive, body.arm
    if drive is not None:
        jerk = (_NO_JERK_LIMIT,) * len(drive.limits.names)
        drive = replace(drive, limits=replace(drive.limits, jerk=jerk))
    if arm is not None:
        jerk = (_NO_JERK_LIMIT,) * len(arm.limits.names)
        arm = replace(arm, limits=replace(arm.limits, setpoint_jerk=jerk))
    return replace(body, drive=drive, arm=arm)


@dataclass(frozen=True)
class Shape:
    """One immovable obstacle that stands on the floor.

    Attributes:
        kind: ``"cylinder"`` or ``"box"``.
        x: centre in the world frame [m].
        y: centre in the world frame [m].
        yaw: rotation about the vertical axis [rad]; without meaning for a cylinder.
        size_x: radius of a cylinder, or half the length of a box [m].
        size_y: half the width of a box [m]; without meaning for a cylinder.
        height: height above the floor [m].
    """

    kind: Literal["cylinder", "box"]
    x: float
    y: float
    yaw: float
    size_x: float
    size_y: float
    height: float = 0.5

    def __post_init__(self) -> None:
        if self.kind not in ("cylinder", "box"):
            raise ConfigError(f"Unknown shape {self.kind!r}. Valid: 'box', 'cylinder'.")
        if not (self.size_x > 0 and self.size_y > 0 and self.height > 0):
            raise ConfigError(f"A {self.kind} needs positive sizes, got {self.size_x}, {self.size_y}, {self.height}.")
