"""`bhd-record`: episodes of a simulated robot, driven by a brain, into a LeRobotDataset."""

import sys
from collections.abc import Sequence

from bhd_lerobot.cli.start import loading
from bhd_lerobot.options.command import Program, run
from bhd_lerobot.recording.config import RecordConfig


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `bhd-record`; return the exit status."""

    def program(config: RecordConfig) -> int:
        with loading():
            from bhd_lerobot.recording.record import record

        return record(config).exit_status

    return run(Program(RecordConfig, program), arguments, "record")


if __name__ == "__main__":
    sys.exit(main())
