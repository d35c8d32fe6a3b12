"""The simulated TurtleBot3 Burger as a LeRobot robot."""

from bhd_lerobot.robots.base import SimulatedBase
from bhd_lerobot.robots.config_turtlebot3 import TurtleBot3Config


class TurtleBot3(SimulatedBase):
    """TurtleBot3 Burger with a 360-beam lidar and the camera `front`."""

    config_class = TurtleBot3Config
    name = "turtlebot3"
