"""Configuration of the simulated TurtleBot3 Burger."""

from dataclasses import dataclass, field

from lerobot.robots.config import RobotConfig

from bhd_lerobot.bodies.arenas import ARENAS
from bhd_lerobot.bodies.body import MobileBase, Rates
from bhd_lerobot.bodies.turtlebot3 import turtlebot3_burger
from bhd_lerobot.errors import ConfigError, unknown_name
from bhd_lerobot.robots.host.config import CLOCKS, RealtimeConfig
from bhd_lerobot.sim.lidar import check_beams


@RobotConfig.register_subclass("turtlebot3")
@dataclass(kw_only=True)
class TurtleBot3Config(RobotConfig):
    """Configuration of the robot type ``turtlebot3``.

    Attributes:
        fps: actions a second [Hz]; one `send_action` advances simulated time by 1 / fps. Record at the same rate.
        clock: ``"lockstep"``: simulated time, advanced by `send_action`, as fast as the machine can; ``"realtime"``:
            the wall clock, in processes of its own.
        require_realtime: with ``clock = "realtime"``, refuse to start if the system does not grant SCHED_FIFO.
        realtime: how it runs on the wall clock.
        control_hz: cerebellum ticks a second [Hz], a multiple of fps.
        physics_hz: physics steps a second [Hz], a multiple of control_hz.
        arena: where the robot is when it is used by itself: ``"turtlebot3_world"``, ``"random"`` or ``"empty"``. In a
            task the task decides.
        seed: seed of the arena and of the sensor noise when the robot is used by itself.
        beams: range readings in an observation, a divisor of 360, evenly spaced.
        lidar_noise_std: standard deviation of the range noise [m]; 0 turns it off.
        odometry: observe `x.pos`, `y.pos` and `theta.pos` from the wheel encoders as well.
        imu: observe the angular velocity from the IMU, `imu_x.vel`, `imu_y.vel` and `imu_z.vel`, as well.
        camera: observe the front camera as well.
        camera_width: width of its image [px].
        camera_height: height of its image [px].
        command_timeout_s: age of the last command at which the robot ramps to rest [s].
    """

    fps: int = 10
    clock: str = "lockstep"
    require_realtime: bool = False
    realtime: RealtimeConfig = field(default_factory=RealtimeConfig)
    control_hz: int = 200
    physics_hz: int = 200
    arena: str = "turtlebot3_world"
    seed: int = 0
    beams: int = 360
    lidar_noise_std: float = 0.01
    odometry: bool = False
    imu: bool = False
    camera: bool = False
    camera_width: int = 320
    camera_height: int = 240
    command_timeout_s: float = 0.5

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.clock not in CLOCKS:
            raise ConfigError(unknown_name("clock", self.clock, CLOCKS))
        if self.arena not in ARENAS:
            raise ConfigError(unknown_name("arena", self.arena, ARENAS))
        if self.seed < 0:
            raise ConfigError(f"robot.seed is {self.seed}; seeds start at 0.")
        body = self.body()
        if body.lidar is not None:
            check_beams(self.beams, body.lidar)
        if self.control_hz % 5:
            raise ConfigError(f"control_hz is {self.control_hz}; it must be a multiple of the lidar's 5 Hz.")
        _ = self.rates

    @property
    def rates(self) -> Rates:
        """The three rates."""
        return Rates(self.physics_hz, self.control_hz, self.fps)

    def body(self) -> MobileBase:
        """Return the hardware that this configuration describes."""
        return turtlebot3_burger(
            lidar_noise_std=self.lidar_noise_std,
            command_timeout_s=self.command_timeout_s,
            camera_width=self.camera_width,
            camera_height=self.camera_height,
        )
