"""Configuration of the simulated UR5."""

from dataclasses import dataclass, field

from lerobot.robots.config import RobotConfig

from bhd_lerobot.bodies.body import Arm, Rates
from bhd_lerobot.bodies.ur5 import ur5
from bhd_lerobot.errors import ConfigError, unknown_name
from bhd_lerobot.robots.host.config import CLOCKS, RealtimeConfig

CONTROLS = ("servo", "impedance")
ACTION_SPACES = ("joint", "tool")
SCENES = ("empty", "reach", "pick")


@RobotConfig.register_subclass("ur5")
@dataclass(kw_only=True)
class UR5Config(RobotConfig):
    """Configuration of the robot type ``ur5``.

    Attributes:
        fps: actions a second [Hz]; one `send_action` advances simulated time by 1 / fps. Record at the same rate.
        clock: ``"lockstep"``: simulated time, advanced by `send_action`, as fast as the machine can; ``"realtime"``:
            the wall clock, in processes of its own.
        require_realtime: with ``clock = "realtime"``, refuse to start if the system does not grant SCHED_FIFO.
        realtime: how it runs on the wall clock.
        control_hz: cerebellum ticks a second [Hz], a multiple of fps.
        physics_hz: physics steps a second [Hz], a multiple of control_hz.
        control: ``"servo"``: position servos, stiff and precise, with goals; ``"impedance"``: joint torques that make
            the tool a damped spring, for contact; needs `action_space = "tool"` and takes no goals.
        action_space: ``"joint"``: joint positions; ``"tool"``: a tool pose, from which the bridge computes them.
        tool_pose: observe the tool's pose as well, computed from the joint positions.
        scene: what is on the table when the robot is used by itself: ``"empty"``, ``"reach"`` (a target pose) or
            ``"pick"`` (objects). In a task the task decides.
        seed: seed of the scene and of the sensor noise when the robot is used by itself.
        camera: observe the cameras `scene` and `wrist` as well.
        camera_width: width of their images [px].
        camera_height: height of their images [px].
        stale_after_s: time after the end of the frame that a setpoint was for, until the arm decelerates and holds [s].
    """

    fps: int = 25
    clock: str = "lockstep"
    require_realtime: bool = False
    realtime: RealtimeConfig = field(default_factory=RealtimeConfig)
    control_hz: int = 500
    physics_hz: int = 500
    control: str = "servo"
    action_space: str = "joint"
    tool_pose: bool = False
    scene: str = "empty"
    seed: int = 0
    camera: bool = False
    camera_width: int = 320
    camera_height: int = 240
    stale_after_s: float = 0.1

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, valid in (
            ("clock", CLOCKS),
            ("control", CONTROLS),
            ("action_space", ACTION_SPACES),
            ("scene", SCENES),
        ):
            if getattr(self, name) not in valid:
                raise ConfigError(unknown_name(name, getattr(self, name), valid))
        if self.control == "impedance" and self.action_space != "tool":
            raise ConfigError(
                f"robot.control is 'impedance' and robot.action_space is {self.action_space!r}; "
                "an impedance is commanded by tool poses: use --robot.action_space=tool."
            )
        if self.seed < 0:
            raise ConfigError(f"robot.seed is {self.seed}; seeds start at 0.")
        if not 0 < self.stale_after_s < float("inf"):
            raise ConfigError(
                f"robot.stale_after_s is {self.stale_after_s}; it must be positive and finite. "
                "A time-out of 0 does not mean 'off': the watchdog cannot be turned off."
            )
        _ = self.rates
        self.body()

    @property
    def rates(self) -> Rates:
        """The three rates."""
        return Rates(self.physics_hz, self.control_hz, self.fps)

    def body(self) -> Arm:
        """Return the hardware that this configuration describes."""
        return ur5(
            actuation="torque" if self.control == "impedance" else "position",
            command_timeout_s=1 / self.fps + self.stale_after_s,
            camera_width=self.camera_width,
            camera_height=self.camera_height,
        )
