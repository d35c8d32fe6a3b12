"""`bhd-data`: everything that is done with a dataset between recording and training."""

import argparse
import importlib
import sys
from collections.abc import Sequence

from bhd_lerobot.errors import BhdError
from bhd_lerobot.runs.start import INTERRUPTED, leaving_on_interrupt

# Modules, in the order of the help. What takes long to import, such as torch, is imported by a command when it runs.
COMMANDS = (
    "data_info",
    "data_timing",
    "data_check",
    "data_repair",
    "data_mark",
    "data_edit",
    "data_view",
    "data_push",
    "data_pull",
    "data_export",
    "data_import",
)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="bhd-data", description=__doc__.split(": ", 1)[1])
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", title="commands", required=True)
    for name in COMMANDS:
        importlib.import_module(f"bhd_lerobot.runs.{name}").add_to(commands)
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `bhd-data`; return the exit status."""
    with leaving_on_interrupt():
        parser = _parser()
    options = parser.parse_args(arguments)
    try:
        return options.run(options)
    except BhdError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"Stopped; {options.stopped}.", file=sys.stderr)
        return INTERRUPTED


if __name__ == "__main__":
    sys.exit(main())
