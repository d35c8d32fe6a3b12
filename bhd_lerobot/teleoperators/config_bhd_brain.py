"""Configuration of the teleoperator `bhd_brain`."""

from dataclasses import dataclass, field

from lerobot.teleoperators.config import TeleoperatorConfig

import bhd_lerobot.registry  # noqa: F401  registers the brains
from bhd_lerobot.policies.brain import BrainConfig
from bhd_lerobot.policies.navigation.avoidance import AvoidanceConfig


@TeleoperatorConfig.register_subclass("bhd_brain")
@dataclass
class BhdBrainConfig(TeleoperatorConfig):
    """Configuration of the teleoperator type ``bhd_brain``.

    Attributes:
        brain: the brain that drives the robot; `--teleop.brain.type=...` chooses another.
        robot_id: `id` of the robot that it drives, needed where several simulated robots are connected in one process.
        seed: seed of what is random in the brain.
        fps: frames a second that the brain counts with [Hz]; the robot's if 0.
    """

    brain: BrainConfig = field(default_factory=AvoidanceConfig)
    robot_id: str | None = None
    seed: int = 0
    fps: int = 0
