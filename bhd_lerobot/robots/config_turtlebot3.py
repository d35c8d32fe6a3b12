"""Configuration of the simulated TurtleBot3 Burger."""

from dataclasses import dataclass

from lerobot.robots.config import RobotConfig

from bhd_lerobot.bodies.body import Body
from bhd_lerobot.bodies.turtlebot3 import turtlebot3_burger
from bhd_lerobot.robots.config import MobileBaseConfig


@RobotConfig.register_subclass("turtlebot3")
@dataclass(kw_only=True)
class TurtleBot3Config(MobileBaseConfig):
    """Configuration of the robot type ``turtlebot3``: the options of a base."""

    def body(self) -> Body:
        """Return the hardware that this configuration describes."""
        return turtlebot3_burger(
            lidar_noise_std=self.lidar_noise_std,
            command_timeout_s=self.command_timeout_s,
            camera_width=self.camera_width,
            camera_height=self.camera_height,
        )
