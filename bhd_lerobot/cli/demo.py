"""`make demo`: record, replay, train and evaluate two robots in a few minutes."""

import sys
from collections.abc import Sequence
from pathlib import Path

from bhd_lerobot.apps import demo
from bhd_lerobot.options.command import Parser, exit_status


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the demo; return the exit status."""
    parser = Parser(prog="python -m bhd_lerobot.cli.demo", description=demo.__doc__)
    parser.add_argument("folder", nargs="?", type=Path, help="new folder; one in outputs/demo if not set")
    return exit_status(lambda: demo.run(parser.parse(arguments).folder), "Stopped. What was finished is complete.")


if __name__ == "__main__":
    sys.exit(main())
