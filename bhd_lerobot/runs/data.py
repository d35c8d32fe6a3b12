"""`bhd-data`: everything that is done with a dataset between recording and training."""

import argparse
import sys
from collections.abc import Sequence

from bhd_lerobot.errors import BhdError
from bhd_lerobot.runs import (
    data_check,
    data_edit,
    data_export,
    data_import,
    data_info,
    data_mark,
    data_pull,
    data_push,
    data_repair,
    data_timing,
    data_view,
)

# In the order of the help. What takes long to import, such as torch, is imported by a command when it runs.
COMMANDS = (
    data_info,
    data_timing,
    data_check,
    data_repair,
    data_mark,
    data_edit,
    data_view,
    data_push,
    data_pull,
    data_export,
    data_import,
)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="bhd-data", description=__doc__.split(": ", 1)[1])
    commands = parser.add_subparsers(dest="command", required=True)
    for command in COMMANDS:
        command.add_to(commands)
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `bhd-data`; return the exit status."""
    options = _parser().parse_args(arguments)
    try:
        return options.run(options)
    except BhdError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"Stopped; {options.stopped}.", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
