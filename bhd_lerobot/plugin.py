"""Every registration with LeRobot. LeRobot imports it through the distribution's module `lerobot_robot_bhd`."""

from bhd_lerobot.versions import check_version

check_version("lerobot")

import bhd_lerobot.policies.cnn.processor_cnn
import bhd_lerobot.policies.mlp.processor_mlp
import bhd_lerobot.policies.pixels.processor_pixels
import bhd_lerobot.registry  # noqa: F401  registers the robots, and the modules above the steps of processors
from bhd_lerobot.envs.config_env import BhdEnvConfig
from bhd_lerobot.policies.cnn.configuration_cnn import CnnConfig
from bhd_lerobot.policies.mlp.configuration_mlp import MlpConfig
from bhd_lerobot.policies.perception.configuration_perception import PerceptionConfig
from bhd_lerobot.policies.pixels.configuration_pixels import PixelsConfig
from bhd_lerobot.ros2.robots.config_robot import Ros2RobotConfig
from bhd_lerobot.teleoperators.config_bhd_brain import BhdBrainConfig
from bhd_lerobot.teleoperators.config_bhd_keyboard_arm import BhdKeyboardArmConfig
from bhd_lerobot.teleoperators.config_bhd_keyboard_base import BhdKeyboardBaseConfig

# Nothing here imports MuJoCo: LeRobot's commands import this module, whatever robot they are used with.
# Importing a configuration registers its type with LeRobot's choice registries. A checkpoint's processors are loaded by
# the names of their steps, by whatever program: LeRobot imports a policy's module when it makes the policy, and the
# module of its processors only when it makes new ones.
__all__ = [
    "BhdBrainConfig",
    "BhdEnvConfig",
    "BhdKeyboardArmConfig",
    "BhdKeyboardBaseConfig",
    "CnnConfig",
    "MlpConfig",
    "PerceptionConfig",
    "PixelsConfig",
    "Ros2RobotConfig",
]
