"""What the configurations of all simulated robots have in common."""

from abc import abstractmethod
from dataclasses import dataclass, field, fields, replace
from typing import Annotated, Any, ClassVar

from lerobot.robots.config import RobotConfig

from bhd_lerobot.bodies.arenas import ARENAS, Arena, make_arena
from bhd_lerobot.bodies.body import Body, Drive, Rates
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.options.declared import OneOf, Whole, check_options
from bhd_lerobot.robots.host.config import CLOCKS, RealtimeConfig
from bhd_lerobot.ros2.live.network import Ros2Config
from bhd_lerobot.sim.lidar import check_beams

_ROS2 = Ros2Config()
ROS2_PLANTS = {
    True: "bhd_lerobot.ros2.robots.base_plant:BasePlant",
    False: "bhd_lerobot.ros2.robots.arm_plant:ArmPlant",
}
"""The plants of ``plant = "ros2"``, of a base and of an arm."""


@dataclass(kw_only=True)
class BhdRobotConfig(RobotConfig):
    """Options of every simulated robot.

    Attributes:
        fps: actions a second [Hz]; one `send_action` advances simulated time by 1 / fps. Record at the same rate.
        clock: ``"lockstep"``: simulated time, advanced by `send_action`, as fast as the machine can; ``"realtime"``:
            the wall clock, in a process of its own.
        require_realtime: with ``clock = "realtime"``, refuse to start if the system does not grant SCHED_FIFO.
        realtime: how it runs on the wall clock.
        plant: what is driven in place of a simulated robot: ``"ros2"``, a robot of this type on a ROS 2 network;
            ``"lerobot"``, an arm that LeRobot drives, `device`; or a class of any package,
            ``"package.module:Class"``, see "Write a plant for your robot", which needs `clock = "realtime"`.
        ros2: the network of ``plant = "ros2"``.
        jerk_limits: let accelerations change gradually when setpoints are followed. Off, they change at once.
        control_hz: cerebellum ticks a second [Hz], a multiple of fps.
        physics_hz: physics steps a second [Hz], a multiple of control_hz.
        seed: seed of the scene and of the sensor noise when the robot is used by itself.
        camera: observe the robot's cameras as well.
        camera_width: width of their images [px].
        camera_height: height of their images [px].
        not_recorded: options that say where a robot is and not what it is, such as an address: datasets do not name
            them, and are continued with others. A robot type may have some.
    """

    not_recorded: ClassVar[tuple[str, ...]] = ()

    fps: int
    clock: Annotated[str, OneOf(CLOCKS)] = "lockstep"
    require_realtime: bool = False
    realtime: RealtimeConfig = field(default_factory=RealtimeConfig)
    plant: str = ""
    ros2: Ros2Config = field(default_factory=Ros2Config)
    jerk_limits: bool = True
    control_hz: int
    physics_hz: int
    seed: Whole = 0
    camera: bool = False
    camera_width: int = 320
    camera_height: int = 240

    def __post_init__(self) -> None:
        super().__post_init__()
        check_options(self, "robot.")
        _ = self.rates
        if self.plant == "ros2":
            body: Body = self.body()
            if body.drive is not None and body.arm is not None:
                raise ConfigError(
                    f"robot.plant is 'ros2', which drives a base or an arm on a table; robot.type is {self.type!r}, an "
                    "arm on a base. Drive it by --robot.type=ros2 with a mapping of its topics, or name a class of "
                    "your own, --robot.plant=package.module:Class."
                )
            self.plant = ROS2_PLANTS[body.drive is not None]
            self.clock = "realtime"
            timeout_s = max(self.realtime.plant_timeout_s, self.ros2.silent_s)
            brain_s = self.realtime.brain_timeout_s
            brain_s = self.ros2.timeout_s if brain_s is None else brain_s
            self.realtime = replace(self.realtime, plant_timeout_s=timeout_s, brain_timeout_s=brain_s)
        if self.plant:
            self._check_plant()
        elif given := [
            one.name for one in fields(Ros2Config) if getattr(self.ros2, one.name) != getattr(_ROS2, one.name)
        ]:
            raise ConfigError(
                f"robot.ros2.{given[0]} is of a robot on a network; add --robot.plant=ros2 or leave it out."
            )

    def _check_plant(self) -> None:
        module, sign, name = self.plant.partition(":")
        if not (sign and name.isidentifier() and all(part.isidentifier() for part in module.split("."))):
            names = "name a class as package.module:Class; or ros2, or for an arm lerobot"
            raise ConfigError(f"robot.plant is {self.plant!r}; {names}.")
        if self.clock != "realtime":
            raise ConfigError("robot.plant names a robot that goes on by itself: use --robot.clock=realtime with it.")
        if self.camera:
            raise ConfigError("robot.camera is of simulated robots; with robot.plant leave it false.")

    @property
    def rates(self) -> Rates:
        """The three rates."""
        return Rates(self.physics_hz, self.control_hz, self.fps)

    def check_rates(self) -> None:
        """Check that the robot works at its rates: a plant's physics has no rate.

        Raises:
            ConfigError: a rate is too low; the message gives the nearest that work.
        """
        self.body().check_rates(self.rates, is_simulated=not self.plant)

    @abstractmethod
    def body(self) -> Any:
        """Return the hardware that this configuration describes."""

    @abstractmethod
    def start_scene(self) -> Any:
        """Return the scene that a robot is in that is used by itself."""


@dataclass(kw_only=True)
class MobileBaseConfig(BhdRobotConfig):
    """Options of every base on two driven wheels with a lidar. A subclass states what it is made of, in `body`.

    Attributes:
        arena: where the robot is when it is used by itself: ``"turtlebot3_world"``, ``"random"`` or ``"empty"``. In a
            task the task decides.
        beams: range readings in an observation, a divisor of those of the lidar, evenly spaced.
        lidar_noise_std: standard deviation of the range noise [m]; 0 turns it off.
        odometry: observe `x.pos`, `y.pos` and `theta.pos` from the wheel encoders as well.
        imu: observe the angular velocity from the IMU, `imu_x.vel`, `imu_y.vel` and `imu_z.vel`, as well.
        collision_monitor: let the robot drive, whoever commands it, only as fast as it can brake before it gets to what
            its lidar sees.
        command_timeout_s: age of the last command at which the robot ramps to rest [s].
    """

    fps: int = 10
    control_hz: int = 200
    physics_hz: int = 200
    arena: Annotated[str, OneOf(ARENAS)] = "turtlebot3_world"
    beams: int = 360
    lidar_noise_std: float = 0.01
    odometry: bool = False
    imu: bool = False
    collision_monitor: bool = False
    command_timeout_s: float = 0.5

    def __post_init__(self) -> None:
        super().__post_init__()
        lidar = self.body().lidar
        if lidar is None:
            raise ConfigError(f"The body of {type(self).__name__} has no lidar, which a simulated base needs.")
        check_beams(self.beams, lidar)
        if self.control_hz % lidar.rate_hz:
            raise ConfigError(
                f"control_hz is {self.control_hz}; it must be a multiple of the lidar's {lidar.rate_hz} Hz."
            )
        self.check_rates()

    @abstractmethod
    def body(self) -> Body:
        """Return the hardware that this configuration describes."""

    def start_scene(self) -> Arena:
        """Return the configured arena."""
        return make_arena(self.arena, self.seed, robot_radius=self.body().need(Drive).radius)
