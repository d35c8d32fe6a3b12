"""Every registration with LeRobot. LeRobot imports it through the distribution's module `lerobot_robot_bhd`."""

from bhd_lerobot.envs.config_env import BhdEnvConfig
from bhd_lerobot.policies.mlp.configuration_mlp import MlpConfig
from bhd_lerobot.robots.config_turtlebot3 import TurtleBot3Config
from bhd_lerobot.robots.config_ur5 import UR5Config
from bhd_lerobot.teleoperators.config_bhd_brain import BhdBrainConfig

# Importing a configuration registers its type with LeRobot's choice registries.
__all__ = ["BhdBrainConfig", "BhdEnvConfig", "MlpConfig", "TurtleBot3Config", "UR5Config"]
