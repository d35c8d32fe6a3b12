"""`bhd-replay`: replay recorded episodes, and measure how far they diverge from the recording."""

import sys
from collections.abc import Sequence

from rich.console import Console

from bhd_lerobot.options.command import Program, run
from bhd_lerobot.rollout.replay import ReplayConfig, replay, root_of
from bhd_lerobot.rollout.replay_robot import replay_on_robot


def _replay(config: ReplayConfig) -> int:
    if config.robot is not None:
        replay_on_robot(root_of(config), config.dataset.episode, config.robot, config.gate, Console(stderr=True))
        return 0
    worst = max(float(result.position_m.max()) for result in replay(config))
    return int(config.tolerance_m is not None and not worst <= config.tolerance_m)  # what is not a number is not


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `bhd-replay`; return the exit status: 1 if the replay differs by more than `tolerance_m`."""
    return run(Program(ReplayConfig, _replay), arguments)


if __name__ == "__main__":
    sys.exit(main())
