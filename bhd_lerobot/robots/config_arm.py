"""Configurations of simulated arms."""

import pickle
from abc import abstractmethod
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar

import draccus
import numpy as np
from lerobot.robots.config import RobotConfig

from bhd_lerobot.bodies.arm_file import ArmFile, GripperFile
from bhd_lerobot.bodies.body import OBSTACLE, Arm, Body, Capsule
from bhd_lerobot.bodies.so101 import JAW_READINGS, SO101
from bhd_lerobot.bodies.tabletop import TableScene
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.options.declared import OneOf, Positive, Range
from bhd_lerobot.options.parse import decode
from bhd_lerobot.robots.config import BhdRobotConfig

_DEVICE_PLANT = "bhd_lerobot.robots.device.plant:DevicePlant"
_DEVICE_TIMEOUT_S = 0.1  # a serial bus repeats what was lost
_FARTHEST = 1000.0  # [m] of an obstacle: of far larger numbers the squares are infinite, and distances no numbers


@dataclass
class _Device:
    device: RobotConfig


@dataclass(kw_only=True)
class ArmConfig(BhdRobotConfig):
    """Options of every arm with a gripper. A subclass states what it is made of, in `body`.

    Attributes:
        control: ``"servo"``: position servos, stiff and precise, with goals; ``"impedance"``: joint torques that make
            the tool a damped spring, for contact; needs `action_space = "tool"` and takes no goals.
        action_space: ``"joint"``: joint positions; ``"tool"``: a tool pose, from which the bridge computes them.
        tool_pose: observe the tool's pose as well, computed from the joint positions.
        scene: what is on the table when the robot is used by itself: ``"empty"``, ``"reach"`` (a target pose) or
            ``"pick"`` (objects). In a task the task decides.
        max_force: force [N] with which the tool may press on something, whatever moves it; more is a protective stop.
            It is estimated from the motors' efforts: with 150 N the arm is stopped at 160 N in the median, below 190 N
            in 95 % and below 240 N in 99 % of postures and directions at 0.02 m/s, and at 0.25 m/s at 270, 380 and 430
            N; the others are those that its joints hardly feel. A force on another part of the arm counts with what the
            joints feel of it. Of a plant that measures no efforts, such as a ROS 2 driver, nothing is limited.
        payload: mass of what the gripper is going to carry [kg]. Accelerations are planned so that the motors can move
            it; what it weighs beyond that, by 20 N, stops the arm when it is at rest.
        held_clearance: keep what the gripper holds away from table, arm and obstacles as well. It is taken to reach as
            far down as the table was below the tool when the gripper closed, at most 0.2 m; false where things are
            taken from something that stands on the table, and put lower. Used with ``control = "servo"``.
        obstacles: what is known to be in its way besides the table and itself: capsules, each with x, y, z of one end,
            x, y, z of the other, and the radius, in the base frame [m]. Goals and setpoints keep away from them.
        wrench: record what the surroundings put on the tool as well, force and moment as estimated from the motors'
            efforts: `control.wrench`.
        device: the robot of ``plant = "lerobot"``, with LeRobot's own options: any that observes and takes positions.
        units: what its readings mean, by joint: ``deg``, ``rad``, or two readings with the positions [rad, m] that they
            mean, ``[[0, 0.0], [100, 1.57]]``; with ``{from: NAME, is: …}`` those of another feature. Degrees and
            ±100 of a calibrated bus are known, and the jaw of an SO-101.
        servos: of an arm from a file, stiffness [N m/rad], damping [N m s/rad] and friction [N m] of joints by name, in
            place of the file's: what `bhd-doctor` finds out with ``--identify``.
        stale_after_s: time after the end of the frame that a setpoint was for, until the arm decelerates and holds [s].
    """

    usual_units: ClassVar[dict[str, Any]] = {}

    fps: int = 25
    control_hz: int = 500
    physics_hz: int = 500
    control: Annotated[str, OneOf(("servo", "impedance"))] = "servo"
    action_space: Annotated[str, OneOf(("joint", "tool"))] = "joint"
    tool_pose: bool = False
    scene: Annotated[str, OneOf(("empty", "reach", "pick"))] = "empty"
    max_force: Annotated[float, Range("(0, inf]")] = 150.0
    payload: float = 0.0
    held_clearance: bool = True
    obstacles: list[list[float]] = field(default_factory=list)
    wrench: bool = False
    device: dict[str, Any] = field(default_factory=dict)  # draccus would look for robots in robots without an end
    units: dict[str, Any] = field(default_factory=dict)
    servos: dict[str, list[float]] = field(default_factory=dict)
    stale_after_s: Positive = 0.1

    def __post_init__(self) -> None:
        if isinstance(self.device, RobotConfig):
            self.device = {"type": self.device.type, **draccus.encode(self.device)}
        if self.plant == "lerobot":
            self.plant, self.clock = _DEVICE_PLANT, "realtime"
            timeout_s = max(self.realtime.plant_timeout_s, _DEVICE_TIMEOUT_S)
            self.realtime = replace(self.realtime, plant_timeout_s=timeout_s)
        self._check_device()
        super().__post_init__()
        if self.control == "impedance" and self.action_space != "tool":
            raise ConfigError(
                f"robot.control is 'impedance' and robot.action_space is {self.action_space!r}; "
                "an impedance is commanded by tool poses: use --robot.action_space=tool."
            )
        for number, values in enumerate(self.obstacles):
            if len(values) != 7 or not np.abs(values).max() <= _FARTHEST or not values[6] > 0:
                raise ConfigError(
                    f"robot.obstacles has {values} as number {number}; an obstacle is 7 numbers of at most "
                    f"{_FARTHEST:g} m: x, y, z of one end, x, y, z of the other, and the radius, which is positive."
                )
        self.check_rates()

    def _check_device(self) -> None:
        if self.plant != _DEVICE_PLANT:
            if self.device or self.units:
                name = "device" if self.device else "units"
                raise ConfigError(f"robot.{name} is of plant=lerobot; add --robot.plant=lerobot or leave it out.")
        elif not self.device:
            raise ConfigError(
                "robot.plant is 'lerobot', and robot.device is not set: say which robot of LeRobot it is, for example "
                "--robot.device.type=so101_follower --robot.device.port=/dev/ttyACM0 --robot.device.id=arm."
            )
        elif isinstance(self.device_config, BhdRobotConfig):
            raise ConfigError(
                f"robot.device.type is {self.device['type']!r}, a robot of this package; name one that LeRobot drives."
            )
        elif self.control != "servo":
            raise ConfigError(
                f"robot.control is {self.control!r}, and robot.device takes positions: use --robot.control=servo."
            )
        elif self.body().drive is not None:
            raise ConfigError(f"robot.plant is 'lerobot', and {self.type} has wheels, too: choose an arm alone.")
        if self.servos and not isinstance(self, ModelArmConfig):
            raise ConfigError(f"robot.servos is of arms from a file, and those of {self.type} are known: leave it out.")

    @property
    def device_config(self) -> RobotConfig:
        """The configuration of the device.

        Raises:
            ConfigError: there is none of its type, or an option is missing or not valid.
        """
        return decode(_Device, {"device": dict(self.device)}, "robot.").device

    @property
    def notes(self) -> list[str]:
        """What a device does not tell, for whoever starts it."""
        if not self.device:
            return []
        return [
            f"{self.device['type']} tells positions only: speeds are the slopes of its last readings, efforts are not "
            "known, so robot.max_force limits nothing. Commands make up for the arm's weight, not for what it holds."
        ]

    def plant_values(self) -> dict[str, Any]:
        """Return what the plant in another process, without a class of LeRobot, needs besides plain options."""
        if not self.device:
            return {}
        return {"device": pickle.dumps(self.device_config), "units": {**self.usual_units, **self.units}}

    @property
    def capsules(self) -> list[Capsule]:
        """What is known to be in the way, as `bodies.body.ArmChain` takes it."""
        return [
            Capsule(f"{OBSTACLE}{number}", 0, (x, y, z), (to_x, to_y, to_z), radius)
            for number, (x, y, z, to_x, to_y, to_z, radius) in enumerate(self.obstacles)
        ]

    @abstractmethod
    def body(self) -> Body:
        """Return the hardware that this configuration describes."""

    def start_scene(self) -> TableScene:
        """Return the configured scene: empty, or one of a task."""
        from bhd_lerobot.tasks.pick import PickConfig, PickTask
        from bhd_lerobot.tasks.reach import ReachConfig, ReachTask

        body = self.body()
        if self.scene == "reach":
            return ReachTask(ReachConfig(), 1, self.fps, body).sample(self.seed)
        if self.scene == "pick":
            return PickTask(PickConfig(), 1, self.fps, body).sample(self.seed)
        return TableScene("empty", (), body.need(Arm).home)


@dataclass
class GripperOptions:
    """The gripper of an arm in a file.

    Attributes:
        name: its actuator, the tendon that this pulls, or its joint, by name; the one that the file has if empty,
            ``none`` for an arm without one.
        open: where its joint is when it is open [m or rad]; the end of its range that is farther open if not set.
        closed: where its joint is when it is closed [m or rad]; the other end if not set.
        opening: distance between the fingers where it is open [m]; the way of its finger tips if not set.
    """

    name: str = ""
    open: float | None = None
    closed: float | None = None
    opening: float | None = None


@dataclass(kw_only=True)
class ModelArmConfig(ArmConfig):
    """Options of arms whose model is a file. A subclass says which, in `file`."""

    def __post_init__(self) -> None:
        for name, values in self.servos.items():
            if len(values) != 3 or not np.isfinite(values).all() or not values[0] > 0 or min(values) < 0:
                raise ConfigError(
                    f"robot.servos has {values} for {name!r}; it needs stiffness, which is positive, damping and "
                    "friction, which are not negative."
                )
        super().__post_init__()

    @property
    def measured(self) -> tuple[tuple[str, float, float, float], ...]:
        """The servos that were measured, as `ArmFile` takes them."""
        return tuple((name, values[0], values[1], values[2]) for name, values in self.servos.items())

    @property
    @abstractmethod
    def file(self) -> ArmFile:
        """The file, and what it does not say."""

    def body(self) -> Body:
        """Return the hardware that this configuration describes."""
        from bhd_lerobot.sim.files.arm import arm_body  # imports MuJoCo

        if self.control == "impedance":
            raise ConfigError("robot.control is 'impedance'; this arm has position servos: use --robot.control=servo.")
        return arm_body(
            self.file,
            load=self.payload,
            obstacles=self.capsules,
            command_timeout_s=1 / self.fps + self.stale_after_s,
            camera_width=self.camera_width,
            camera_height=self.camera_height,
        )


@RobotConfig.register_subclass("so101")
@dataclass(kw_only=True)
class SO101Config(ModelArmConfig):
    """Configuration of the robot type ``so101``: the options of an arm."""

    usual_units: ClassVar[dict[str, Any]] = {"gripper": JAW_READINGS}

    @property
    def file(self) -> ArmFile:
        """The file, and what it does not say."""
        return replace(SO101, servos=self.measured)


@RobotConfig.register_subclass("arm")
@dataclass(kw_only=True)
class FileArmConfig(ModelArmConfig):
    """Configuration of the robot type ``arm``: any arm, by its file. What is not set is read from it, or guessed.

    A subclass with values of its own is a robot of its own.

    Attributes:
        mjcf: the file: MJCF, or URDF as MuJoCo reads it. Of a scene the robot alone is taken.
        tool: the site of the tool centre point, or a body, by name.
        tool_offset: where the tool centre point is in that site or body, x, y, z [m].
        gripper: the gripper.
        home: posture that it starts in, one number for each joint [rad].
        ranges: lowest and highest position [rad] of joints by name, in place of the file's.
        velocity: largest speed of each joint, or of all of them [rad/s]; a URDF says it, for an MJCF 2 is an estimate.
        acceleration: largest acceleration, likewise [rad/s^2].
        effort: largest torque, likewise [N m].
    """

    mjcf: Path | None = None
    tool: str = ""
    tool_offset: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    gripper: GripperOptions = field(default_factory=GripperOptions)
    home: list[float] = field(default_factory=list)
    ranges: dict[str, list[float]] = field(default_factory=dict)
    velocity: list[float] = field(default_factory=list)
    acceleration: list[float] = field(default_factory=list)
    effort: list[float] = field(default_factory=list)

    def __post_init__(self) -> None:
        # As they are recorded, and as JSON has them.
        self.mjcf = None if self.mjcf is None else Path(self.mjcf)
        self.gripper = GripperOptions(**self.gripper) if isinstance(self.gripper, dict) else self.gripper
        super().__post_init__()

    def check_rates(self) -> None:
        """Check that the robot works at its rates, as far as it is known what robot it is."""
        if self.mjcf is not None:
            super().check_rates()

    @property
    def file(self) -> ArmFile:
        """The file, and what it does not say.

        Raises:
            ConfigError: there is none, or what is said of it is not valid.
        """
        if not self.mjcf:
            raise ConfigError("robot.mjcf is not set: name the file of the arm, --robot.mjcf=FILE, an MJCF or a URDF.")
        for name, values in self.ranges.items():
            if len(values) != 2:
                raise ConfigError(f"robot.ranges has {values} for {name!r}; it needs the lowest and the highest [rad].")
        if len(self.tool_offset) != 3 or not np.isfinite(self.tool_offset).all():
            raise ConfigError(f"robot.tool_offset is {self.tool_offset}; it needs three finite numbers [m].")
        return ArmFile(
            name=self.type,
            path=str(self.mjcf),
            tool=self.tool,
            tool_offset=tuple(self.tool_offset),
            gripper=GripperFile(**vars(self.gripper)),
            home=tuple(self.home),
            ranges=tuple((name, low, high) for name, (low, high) in self.ranges.items()),
            servos=self.measured,
            velocity=tuple(self.velocity),
            acceleration=tuple(self.acceleration),
            effort=tuple(self.effort),
        )
