"""A simulated arm on a base as a LeRobot robot."""

from bhd_lerobot.robots.arm import SimulatedArm
from bhd_lerobot.robots.config_mobile_arm import TurtleBot3ManipulationConfig


class SimulatedMobileArm(SimulatedArm):
    """An arm on a base with a lidar. A subclass says its name and its configuration, which says its body.

    Action: the arm's, as of a `SimulatedArm`, then the base's, `x.vel` [m/s] and `theta.vel` [rad/s]. Observation: what
    an arm observes, then what a base does. While a goal of the arm is followed, the base comes to rest.

    Args:
        config: the configuration.
    """


class TurtleBot3Manipulation(SimulatedMobileArm):
    """TurtleBot3 Waffle Pi with an OpenMANIPULATOR-X: `joint1` to `joint4`, `gripper`, the wheels and a lidar."""

    config_class = TurtleBot3ManipulationConfig
    name = "turtlebot3_manipulation"
