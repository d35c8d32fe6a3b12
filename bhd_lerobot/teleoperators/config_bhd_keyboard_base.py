"""Configuration of the teleoperator `bhd_keyboard_base`."""

from dataclasses import dataclass

from lerobot.teleoperators.config import TeleoperatorConfig

from bhd_lerobot.bodies.turtlebot3 import MAX_ANGULAR, MAX_LINEAR
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.options.declared import Positive
from bhd_lerobot.teleoperators.config_keyboard import KeyboardConfig


@TeleoperatorConfig.register_subclass("bhd_keyboard_base")
@dataclass(kw_only=True)
class BhdKeyboardBaseConfig(KeyboardConfig):
    """Configuration of the teleoperator type ``bhd_keyboard_base``.

    Attributes:
        linear_speed: speed forward and back at the start [m/s].
        angular_speed: yaw rate at the start [rad/s].
        max_linear_speed: the most that keys can make of it [m/s]; by default the TurtleBot3 Burger's limit.
        max_angular_speed: the most that keys can make of it [rad/s]; by default the TurtleBot3 Burger's limit.
    """

    linear_speed: Positive = MAX_LINEAR
    angular_speed: Positive = 1.0
    max_linear_speed: Positive = MAX_LINEAR
    max_angular_speed: Positive = MAX_ANGULAR

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("linear_speed", "angular_speed"):
            if (speed := getattr(self, name)) > (most := getattr(self, f"max_{name}")):
                raise ConfigError(
                    f"teleop.{name} is {speed:g}, and teleop.max_{name} is {most:g}. Lower the one or raise the other."
                )
