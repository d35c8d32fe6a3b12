"""What is physically there, as data: joints, actuators, sensors, limits and rates of a robot, and the shapes around it.

Nothing here computes and nothing here knows a physics engine. Every other room that needs a number about hardware reads
it from a `Body`, so that a simulated and a real robot are limited by the same figures.
"""

from dataclasses import dataclass, field
from typing import Literal

from bhd_lerobot.errors import ConfigError


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
            if isinstance(value, bool) or not isinstance(value, int) or value <= 0:
                raise ConfigError(f"{name} is {value!r}; it must be a positive whole number of Hz.")
        for slow_name, slow, fast_name, fast in (
            ("control_hz", self.control_hz, "physics_hz", self.physics_hz),
            ("fps", self.fps, "control_hz", self.control_hz),
        ):
            if fast % slow:
                valid = ", ".join(str(rate) for rate in range(1, fast + 1) if fast % rate == 0)
                raise ConfigError(
                    f"{slow_name} is {slow} Hz, which does not divide {fast_name} = {fast} Hz. "
                    f"In lockstep every rate divides the one above it; valid values of {slow_name}: {valid}."
                )

    @property
    def steps_per_tick(self) -> int:
        """Physics steps in one control tick."""
        return self.physics_hz // self.control_hz

    @property
    def ticks_per_frame(self) -> int:
        """Control ticks in one frame."""
        return self.control_hz // self.fps


@dataclass(frozen=True)
class CommandLimits:
    """Limits of a velocity command, one value for each command dimension.

    Attributes:
        names: the command dimensions, in the order of the action features.
        velocity: largest magnitude [m/s or rad/s].
        acceleration: largest change per second in normal motion [m/s^2 or rad/s^2].
        stop_deceleration: largest change per second when the robot has to stop, on an emergency stop for example
            [m/s^2 or rad/s^2].
        command_timeout_s: age at which the last command is no longer trusted and the robot ramps to zero [s].
    """

    names: tuple[str, ...]
    velocity: tuple[float, ...]
    acceleration: tuple[float, ...]
    stop_deceleration: tuple[float, ...]
    command_timeout_s: float

    def __post_init__(self) -> None:
        for name in ("velocity", "acceleration", "stop_deceleration"):
            values = getattr(self, name)
            if len(values) != len(self.names) or not all(0 < v < float("inf") for v in values):
                raise ConfigError(f"{name} is {values}; it needs {len(self.names)} positive finite numbers.")
        if not 0 < self.command_timeout_s < float("inf"):
            raise ConfigError(
                f"command_timeout_s is {self.command_timeout_s}; it must be positive and finite. "
                "A time-out of 0 does not mean 'off': the watchdog cannot be turned off."
            )


@dataclass(frozen=True)
class WheelDrive:
    """Two driven wheels on one axis, each with a velocity servo.

    Attributes:
        joints: joint names, left then right.
        actuators: actuator names, left then right.
        wheel_radius: rolling radius [m].
        wheel_separation: distance between the contact points [m].
        max_wheel_speed: largest wheel speed [rad/s].
        max_torque: largest wheel torque [N m].
        servo_gain: torque per speed error of the velocity servo [N m s/rad].
        encoder_ticks: encoder counts in one wheel revolution.
    """

    joints: tuple[str, str]
    actuators: tuple[str, str]
    wheel_radius: float
    wheel_separation: float
    max_wheel_speed: float
    max_torque: float
    servo_gain: float
    encoder_ticks: int


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
    """

    site: str
    beams: int
    range_min: float
    range_max: float
    rate_hz: int
    noise_std: float


@dataclass(frozen=True)
class CameraSpec:
    """A camera of the body.

    Attributes:
        name: camera name in the model.
        width: image width [px].
        height: image height [px].
    """

    name: str
    width: int
    height: int


@dataclass(frozen=True)
class Body:
    """A robot's hardware.

    Attributes:
        name: body name, for example ``"turtlebot3_burger"``.
        mjcf: MJCF document of the robot alone, without floor or scene.
        root: name of the root body, which carries a free joint if the robot moves.
        limits: limits of the commands it takes.
        drive: the wheels.
        lidar: the range finder, or None.
        cameras: the cameras, by name.
        touch_sensor: name of the contact sensor that counts touches with the scene.
        radius: radius of the vertical cylinder around the root body's origin that holds the whole robot [m].
        height: height of the robot [m].
        physics_hz: default physics rate [Hz].
        control_hz: default control rate [Hz].
    """

    name: str
    mjcf: str
    root: str
    limits: CommandLimits
    drive: WheelDrive
    lidar: LidarSpec | None
    cameras: dict[str, CameraSpec] = field(default_factory=dict)
    touch_sensor: str = "touch"
    radius: float = 0.0
    height: float = 0.0
    physics_hz: int = 200
    control_hz: int = 200


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
