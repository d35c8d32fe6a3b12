"""Configuration of the teleoperator `bhd_keyboard_arm`."""

from dataclasses import dataclass

from lerobot.teleoperators.config import TeleoperatorConfig

from bhd_lerobot.bodies.ur5 import MAX_OPENING
from bhd_lerobot.errors import ConfigError, check_positive, unknown_name
from bhd_lerobot.teleoperators.config_keyboard import KeyboardConfig

ACTION_SPACES = ("tool", "joint")
MAX_SPEED = 0.25  # [m/s] of the tool; the reduced speed of ISO 10218-1, for people near the arm
MAX_TURN_SPEED = 1.0  # [rad/s] of the tool, or of a joint; a third of the UR5's


@TeleoperatorConfig.register_subclass("bhd_keyboard_arm")
@dataclass(kw_only=True)
class BhdKeyboardArmConfig(KeyboardConfig):
    """Configuration of the teleoperator type ``bhd_keyboard_arm``.

    Attributes:
        action_space: that of the robot: ``"tool"``: keys move the tool; ``"joint"``: keys turn the joints of a UR5.
        speed: speed of the tool at the start [m/s]; keys change it up to 0.25.
        turn_speed: rotation of the tool, or of a joint, at the start [rad/s]; keys change it up to 1.
        opening: opening of the open gripper [m]; by default the UR5's.
    """

    action_space: str = "tool"
    speed: float = 0.05
    turn_speed: float = 0.3
    opening: float = MAX_OPENING

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.action_space not in ACTION_SPACES:
            raise ConfigError(unknown_name("teleop.action_space", self.action_space, ACTION_SPACES))
        check_positive("teleop", self, ("speed", "turn_speed", "opening"))
        for name, most in (("speed", MAX_SPEED), ("turn_speed", MAX_TURN_SPEED)):
            if getattr(self, name) > most:
                raise ConfigError(f"teleop.{name} is {getattr(self, name):g}; {most:g} is the most.")
