"""An arm from a file as a robot type of its own: `--robot.type=my_arm`."""

from dataclasses import dataclass, field
from pathlib import Path

from lerobot.robots.config import RobotConfig

import bhd_lerobot as bhd

FILE = Path(__file__).with_name("my_arm.xml")


@RobotConfig.register_subclass("my_arm")
@dataclass(kw_only=True)
class MyArmConfig(bhd.FileArmConfig):
    """Options of the robot type ``my_arm``: those of ``arm``, with values of its own."""

    mjcf: Path | None = FILE
    gripper: bhd.GripperOptions = field(
        default_factory=lambda: bhd.GripperOptions(name="gripper", closed=-0.1745, open=0.85, opening=0.073)
    )
    velocity: list[float] = field(default_factory=lambda: [2.4])


@bhd.register_robot
class MyArm(bhd.SimulatedArm):
    """My arm."""

    config_class = MyArmConfig
    name = "my_arm"
