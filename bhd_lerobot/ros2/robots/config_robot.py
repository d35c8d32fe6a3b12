"""Configuration of any robot on a ROS 2 network."""

from dataclasses import dataclass, field

from lerobot.robots.config import RobotConfig

from bhd_lerobot.errors import ConfigError
from bhd_lerobot.options.declared import Positive, check_options
from bhd_lerobot.ros2.live.network import WHEEL_SPEEDS, Ros2Config


@RobotConfig.register_subclass("ros2")
@dataclass(kw_only=True)
class Ros2RobotConfig(RobotConfig):
    """Configuration of the robot type ``ros2``: any robot on a ROS 2 network.

    Attributes:
        mapping: YAML file that says which field of which topic is which feature, see "Use ROS 2".
        ros2: the network.
        stop: values of actions that stop the robot, sent when no action comes for `ros2.timeout_s`; by default 0 for
            the topics whose actions all are speeds (``.vel``), and nothing for the others, which hold their positions.
        topic_timeout_s: a topic that sends nothing for so long is a fault [s].
    """

    mapping: str
    ros2: Ros2Config = field(default_factory=Ros2Config)
    stop: dict[str, float] = field(default_factory=dict)
    topic_timeout_s: Positive = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.ros2.silence_s is not None:
            raise ConfigError(
                f"robot.ros2.silence_s is {self.ros2.silence_s}; it is of robots with --robot.plant=ros2. Of the robot "
                f"type ros2 use --robot.topic_timeout_s={self.ros2.silence_s}."
            )
        if self.ros2.latency_s is not None:
            raise ConfigError(
                f"robot.ros2.latency_s is {self.ros2.latency_s}; it is of robots with --robot.plant=ros2. Whether a "
                "robot of the type ros2 follows its commands is not supervised."
            )
        if self.ros2.wheel_speeds != WHEEL_SPEEDS[0]:
            raise ConfigError(
                f"robot.ros2.wheel_speeds is {self.ros2.wheel_speeds!r}; it is of robots with --robot.plant=ros2. For "
                "the robot type ros2 set `scale` in the mapping."
            )
        check_options(self, "robot.")
