"""The simulated TurtleBot3 Burger as a LeRobot robot."""

from bhd_lerobot.bodies.arenas import Arena, make_arena
from bhd_lerobot.robots.config_turtlebot3 import TurtleBot3Config
from bhd_lerobot.robots.simulated_robot import SimulatedRobot
from bhd_lerobot.robots.turtlebot3_simulation import TurtleBot3Simulation, observation_names


class TurtleBot3(SimulatedRobot):
    """TurtleBot3 Burger with a 360-beam lidar.

    Action: `x.vel` [m/s] forward, `theta.vel` [rad/s] counter-clockwise. Observation: the same two as measured by the
    wheel encoders, `scan_000.pos` and on [m]; by option `x.pos`, `y.pos`, `theta.pos` (wheel odometry), `imu_x.vel`,
    `imu_y.vel`, `imu_z.vel` (gyroscope), and the image `front`.

    Args:
        config: the configuration.
    """

    config_class = TurtleBot3Config
    name = "turtlebot3"

    def make_simulation(self) -> TurtleBot3Simulation:
        """Return a new simulation of one robot."""
        return TurtleBot3Simulation(self.config)

    def make_scene(self) -> Arena:
        """Return the configured arena."""
        return make_arena(self.config.arena, self.config.seed)

    @property
    def observation_names(self) -> tuple[str, ...]:
        """Names of the observation's floats, in order."""
        return observation_names(self.config)

    @property
    def action_names(self) -> tuple[str, ...]:
        """Names of the action's floats, in order."""
        return TurtleBot3Simulation.action_names

    @property
    def camera_shapes(self) -> dict[str, tuple[int, int, int]]:
        """Image shapes (height, width, 3) by camera name."""
        return {"front": (self.config.camera_height, self.config.camera_width, 3)} if self.config.camera else {}
