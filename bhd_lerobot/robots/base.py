"""A simulated base on two wheels as a LeRobot robot."""

from bhd_lerobot.robots.robot import BhdRobot


class SimulatedBase(BhdRobot):
    """A base with a lidar. A subclass says its name and its configuration, which says its body.

    Action: `x.vel` [m/s] forward, `theta.vel` [rad/s] counter-clockwise. Observation: the same two as measured by the
    wheel encoders, `scan_000.pos` and on [m]; by option `x.pos`, `y.pos`, `theta.pos` (wheel odometry), `imu_x.vel`,
    `imu_y.vel`, `imu_z.vel` (gyroscope), and the images of the body's cameras.

    Args:
        config: the configuration.
    """
