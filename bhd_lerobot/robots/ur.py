"""The simulated arms of Universal Robots as LeRobot robots."""

from bhd_lerobot.robots.arm import SimulatedArm
from bhd_lerobot.robots.config_ur import UR3eConfig, UR5Config, UR5eConfig, UR10eConfig


class UR5(SimulatedArm):
    """UR5 with a parallel gripper: `shoulder_pan`, `shoulder_lift`, `elbow`, `wrist_1`, `wrist_2`, `wrist_3`."""

    config_class = UR5Config
    name = "ur5"


class UR3e(UR5):
    """UR3e, with the joints and the gripper of the UR5."""

    config_class = UR3eConfig
    name = "ur3e"


class UR5e(UR5):
    """UR5e, likewise."""

    config_class = UR5eConfig
    name = "ur5e"


class UR10e(UR5):
    """UR10e, likewise."""

    config_class = UR10eConfig
    name = "ur10e"
