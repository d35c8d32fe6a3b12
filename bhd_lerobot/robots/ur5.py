"""The simulated UR5 as a LeRobot robot."""

from bhd_lerobot.robots.arm import SimulatedArm
from bhd_lerobot.robots.config_ur5 import UR5Config


class UR5(SimulatedArm):
    """UR5 with a parallel gripper: `shoulder_pan`, `shoulder_lift`, `elbow`, `wrist_1`, `wrist_2`, `wrist_3`."""

    config_class = UR5Config
    name = "ur5"
