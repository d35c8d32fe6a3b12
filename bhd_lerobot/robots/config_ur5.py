"""Configuration of the simulated UR5."""

from dataclasses import dataclass

from lerobot.robots.config import RobotConfig

from bhd_lerobot.bodies.body import Body
from bhd_lerobot.bodies.ur5 import ur5
from bhd_lerobot.robots.config_arm import ArmConfig


@RobotConfig.register_subclass("ur5")
@dataclass(kw_only=True)
class UR5Config(ArmConfig):
    """Configuration of the robot type ``ur5``: the options of an arm."""

    def body(self) -> Body:
        """Return the hardware that this configuration describes."""
        return ur5(
            load=self.payload,
            obstacles=self.capsules,
            actuation="torque" if self.control == "impedance" else "position",
            command_timeout_s=1 / self.fps + self.stale_after_s,
            camera_width=self.camera_width,
            camera_height=self.camera_height,
        )
