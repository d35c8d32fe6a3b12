"""`bhd-ros2 serve`: a simulated robot as a ROS 2 robot."""

import sys
from collections.abc import Sequence

from rich.console import Console

from bhd_lerobot.options.command import Program, run
from bhd_lerobot.registry import ROBOTS
from bhd_lerobot.ros2.serve.serve import ServeConfig, serve


def _serve(config: ServeConfig) -> None:
    serve(config, ROBOTS.of(config.robot), Console(stderr=True))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `bhd-ros2 serve`; return the exit status."""
    return run(Program(ServeConfig, _serve), arguments)


if __name__ == "__main__":
    sys.exit(main())
