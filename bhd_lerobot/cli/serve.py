"""`bhd-ros2 serve` and `bhd-ros2 bridge`: a simulated robot on a ROS 2 network, and a real one behind a bridge."""

import sys
from collections.abc import Sequence

from bhd_lerobot.cli.start import loading
from bhd_lerobot.options.command import Program, run
from bhd_lerobot.registry import ROBOTS
from bhd_lerobot.ros2.serve.config import BridgeConfig, ServeConfig


def _serve(config: ServeConfig) -> None:
    with loading():
        from rich.console import Console

        from bhd_lerobot.ros2.serve.serve import serve

    serve(config, ROBOTS.of(config.robot), Console(stderr=True))


def _bridge(config: BridgeConfig) -> None:
    with loading():
        from rich.console import Console

        from bhd_lerobot.ros2.serve.bridge import bridge

    bridge(config, ROBOTS.of(config.robot), Console(stderr=True))


PROGRAMS = {"serve": Program(ServeConfig, _serve), "bridge": Program(BridgeConfig, _bridge)}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command that the first argument names; return the exit status."""
    name, *options = sys.argv[1:] if arguments is None else arguments
    return run(PROGRAMS[name], options)


if __name__ == "__main__":
    sys.exit(main())
