"""`bhd-replay`: replay recorded episodes, and measure how far they diverge from the recording."""

import sys
from collections.abc import Sequence

from bhd_lerobot.cli.start import loading
from bhd_lerobot.options.command import Program, run
from bhd_lerobot.rollout.replay.config import ReplayConfig, root_of


def _replay(config: ReplayConfig) -> int:
    if config.robot is not None:
        with loading():
            from rich.console import Console

            from bhd_lerobot.rollout.replay.on_robot import replay_on_robot

        replay_on_robot(root_of(config), config.dataset.episode, config.robot, config.gate, Console(stderr=True))
        return 0
    with loading():
        from bhd_lerobot.rollout.replay.simulated import replay

    worst = max(float(result.position_m.max()) for result in replay(config))
    return int(config.tolerance_m is not None and not worst <= config.tolerance_m)  # what is not a number is not


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `bhd-replay`; return the exit status: 1 if the replay differs by more than `tolerance_m`."""
    return run(Program(ReplayConfig, _replay), arguments)


if __name__ == "__main__":
    sys.exit(main())
