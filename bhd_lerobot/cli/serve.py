"""`bhd-ros2 serve`: a simulated robot as a ROS 2 robot."""

import sys
from collections.abc import Sequence

from rich.console import Console

import bhd_lerobot.registry  # noqa: F401 - its robots can be named
from bhd_lerobot.options.command import Program, run
from bhd_lerobot.robots.robot import BhdRobot
from bhd_lerobot.ros2.serve.serve import ServeConfig, serve
from bhd_lerobot.stock import make_robot_from_config


def _serve(config: ServeConfig) -> None:
    robot = make_robot_from_config(config.robot)
    assert isinstance(robot, BhdRobot)
    serve(config, robot, Console(stderr=True))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `bhd-ros2 serve`; return the exit status."""
    return run(Program(ServeConfig, _serve), arguments)


if __name__ == "__main__":
    sys.exit(main())
