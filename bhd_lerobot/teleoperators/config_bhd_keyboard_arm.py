"""Configuration of the teleoperator `bhd_keyboard_arm`."""

from dataclasses import dataclass
from typing import Annotated

from lerobot.teleoperators.config import TeleoperatorConfig

from bhd_lerobot.options.declared import OneOf, Positive, Range
from bhd_lerobot.teleoperators.config_keyboard import KeyboardConfig

MAX_SPEED = 0.25  # [m/s] of the tool; the reduced speed of ISO 10218-1, for people near the arm
MAX_TURN_SPEED = 1.0  # [rad/s] of the tool, or of a joint; a third of what an industrial arm's joints turn at


@TeleoperatorConfig.register_subclass("bhd_keyboard_arm")
@dataclass(kw_only=True)
class BhdKeyboardArmConfig(KeyboardConfig):
    """Configuration of the teleoperator type ``bhd_keyboard_arm``.

    Attributes:
        action_space: that of the robot: ``"tool"``: keys move the tool; ``"joint"``: keys turn the joints.
        speed: speed of the tool at the start [m/s]; keys change it up to 0.25.
        turn_speed: rotation of the tool, or of a joint, at the start [rad/s]; keys change it up to 1.
        opening: opening of the open gripper [m]; as far as the gripper opens if not set.
    """

    action_space: Annotated[str, OneOf(("tool", "joint"))] = "tool"
    speed: Annotated[float, Range(f"(0, {MAX_SPEED}]")] = 0.05
    turn_speed: Annotated[float, Range(f"(0, {MAX_TURN_SPEED}]")] = 0.3
    opening: Positive | None = None
