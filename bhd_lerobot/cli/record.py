"""`bhd-record`: episodes of a simulated robot, driven by a brain, into a LeRobotDataset."""

import sys
from collections.abc import Sequence

from bhd_lerobot.cli.start import loading
from bhd_lerobot.errors import DatasetEditedError
from bhd_lerobot.options.command import Program, run
from bhd_lerobot.recording.config import RecordConfig


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `bhd-record`; return the exit status."""
    given = list(sys.argv[1:] if arguments is None else arguments)

    def program(config: RecordConfig) -> int:
        with loading():
            from bhd_lerobot.recording.record import record
            from bhd_lerobot.recording.resume_advice import instead_of_resuming

        try:
            return record(config).exit_status
        except DatasetEditedError as error:
            for line in instead_of_resuming(config, given):
                error.add_note(line)
            raise

    return run(Program(RecordConfig, program), given, "record")


if __name__ == "__main__":
    sys.exit(main())
