"""Configurations of simulated arms on bases."""

from dataclasses import dataclass
from typing import Annotated, Any

from lerobot.robots.config import RobotConfig

from bhd_lerobot.bodies.body import Body
from bhd_lerobot.bodies.fetch_scene import make_fetch_scene
from bhd_lerobot.bodies.turtlebot3_manipulation import turtlebot3_manipulation
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.options.declared import OneOf
from bhd_lerobot.robots.config import MobileBaseConfig
from bhd_lerobot.robots.config_arm import ArmConfig


@dataclass(kw_only=True)
class MobileArmConfig(ArmConfig, MobileBaseConfig):
    """Options of every arm on a base: those of an arm and those of a base. A subclass states its body, in `body`.

    Attributes:
        scene: what is there when the robot is used by itself: ``"empty"``, the `arena` alone, or ``"fetch"``, a room
            with two stands and an object. In a task the task decides.
        command_timeout_s: age of the last command at which arm and base come to rest [s]; at the least the frame that
            it was for, and `stale_after_s`.
    """

    scene: Annotated[str, OneOf(("empty", "fetch"))] = "empty"
    arena: str = "empty"

    def __post_init__(self) -> None:
        if self.control != "servo":
            raise ConfigError("robot.control is 'impedance'; an arm on a base has position servos: leave it out.")
        super().__post_init__()

    @property
    def stale_s(self) -> float:
        """Age of a command at which it is no longer trusted [s]."""
        return min(self.command_timeout_s, 1 / self.fps + self.stale_after_s)

    def start_scene(self) -> Any:
        """Return the configured scene."""
        return make_fetch_scene(self.seed, self.body()) if self.scene == "fetch" else MobileBaseConfig.start_scene(self)


@RobotConfig.register_subclass("turtlebot3_manipulation")
@dataclass(kw_only=True)
class TurtleBot3ManipulationConfig(MobileArmConfig):
    """Configuration of the robot type ``turtlebot3_manipulation``: the options of an arm on a base."""

    def body(self) -> Body:
        """Return the hardware that this configuration describes."""
        return turtlebot3_manipulation(
            load=self.payload,
            obstacles=self.capsules,
            lidar_noise_std=self.lidar_noise_std,
            command_timeout_s=self.stale_s,
            camera_width=self.camera_width,
            camera_height=self.camera_height,
        )
