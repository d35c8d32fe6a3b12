"""A simulated base on two wheels as a LeRobot robot."""

from typing import ClassVar

from bhd_lerobot.bodies.arenas import Arena
from bhd_lerobot.robots.base_host import observation_names
from bhd_lerobot.robots.base_simulation import BaseSimulation
from bhd_lerobot.robots.robot import BhdRobot


class SimulatedBase(BhdRobot):
    """A base with a lidar. A subclass says its name and its configuration, which says its body.

    Action: `x.vel` [m/s] forward, `theta.vel` [rad/s] counter-clockwise. Observation: the same two as measured by the
    wheel encoders, `scan_000.pos` and on [m]; by option `x.pos`, `y.pos`, `theta.pos` (wheel odometry), `imu_x.vel`,
    `imu_y.vel`, `imu_z.vel` (gyroscope), and the images of the body's cameras.

    Args:
        config: the configuration.
    """

    simulation_class: ClassVar[type[BaseSimulation]] = BaseSimulation

    def make_scene(self) -> Arena:
        """Return the configured arena."""
        return self.simulation_class.start_scene(self.config)

    @property
    def observation_names(self) -> tuple[str, ...]:
        """Names of the observation's floats, in order."""
        return observation_names(self.config)
