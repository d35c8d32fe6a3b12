"""Configurations of the simulated arms of Universal Robots."""

from dataclasses import dataclass
from typing import ClassVar

from lerobot.robots.config import RobotConfig

from bhd_lerobot.bodies.body import Body
from bhd_lerobot.bodies.ur import ur
from bhd_lerobot.robots.config_arm import ArmConfig


@RobotConfig.register_subclass("ur5")
@dataclass(kw_only=True)
class UR5Config(ArmConfig):
    """Configuration of the robot type ``ur5``: the options of an arm."""

    model: ClassVar[str] = "ur5"

    def body(self) -> Body:
        """Return the hardware that this configuration describes."""
        return ur(
            self.model,
            load=self.payload,
            obstacles=self.capsules,
            actuation="torque" if self.control == "impedance" else "position",
            command_timeout_s=1 / self.fps + self.stale_after_s,
            camera_width=self.camera_width,
            camera_height=self.camera_height,
        )


@RobotConfig.register_subclass("ur3e")
@dataclass(kw_only=True)
class UR3eConfig(UR5Config):
    """Configuration of the robot type ``ur3e``: the options of an arm."""

    model: ClassVar[str] = "ur3e"


@RobotConfig.register_subclass("ur5e")
@dataclass(kw_only=True)
class UR5eConfig(UR5Config):
    """Configuration of the robot type ``ur5e``: the options of an arm."""

    model: ClassVar[str] = "ur5e"


@RobotConfig.register_subclass("ur10e")
@dataclass(kw_only=True)
class UR10eConfig(UR5Config):
    """Configuration of the robot type ``ur10e``: the options of an arm."""

    model: ClassVar[str] = "ur10e"
