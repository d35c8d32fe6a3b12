"""Which simulation belongs to a robot's configuration."""

from collections.abc import Callable
from typing import Any

from lerobot.robots.config import RobotConfig

from bhd_lerobot.robots.config_turtlebot3 import TurtleBot3Config
from bhd_lerobot.robots.config_ur5 import UR5Config
from bhd_lerobot.robots.host.realtime import make_live
from bhd_lerobot.robots.host.simulation import Simulation
from bhd_lerobot.robots.turtlebot3_simulation import TurtleBot3Simulation
from bhd_lerobot.robots.ur5_simulation import UR5Simulation

# Importing this module registers every configuration that it names.
SIMULATIONS: dict[type[RobotConfig], Callable[[Any, int, int | None], Simulation]] = {
    TurtleBot3Config: TurtleBot3Simulation,
    UR5Config: UR5Simulation,
}
"""The simulations, by the configurations of their robots."""

SIMULATED_ROBOTS = tuple(SIMULATIONS)
"""Configurations of the robots that can be simulated."""


def make_simulation(config: Any, n: int = 1, threads: int | None = None) -> Simulation:
    """Return n simulations of the robot that a configuration describes, on the lockstep clock whatever it says."""
    return SIMULATIONS[type(config)](config, n, threads)


def make_robot(config: Any, n: int = 1, threads: int | None = None) -> Simulation:
    """Return n robots on the clock of the configuration.

    Raises:
        ConfigError: more than one on the wall clock.
        RealtimeError: the processes of a robot on the wall clock could not be started.
    """
    simulation = make_simulation(config, n, threads)
    return make_live(simulation, config.id) if config.clock == "realtime" else simulation


def robot_config(robot_type: str) -> type[RobotConfig]:
    """Return the configuration class of a type of robot that can be simulated."""
    return {kind.get_choice_name(kind): kind for kind in SIMULATIONS}[robot_type]
