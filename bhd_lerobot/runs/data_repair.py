"""`bhd-data repair`: complete or drop what an interruption left."""

import argparse
from pathlib import Path

from bhd_lerobot.data.repair import repair
from bhd_lerobot.runs.data_command import Commands, add_command, root_of


def add_to(commands: Commands) -> None:
    """Add `repair`."""
    help_text = "complete or drop what an interrupted recording left, and leave the dataset compact"
    command = add_command(commands, "repair", help_text, _run)
    command.add_argument(
        "--info",
        type=Path,
        metavar="OTHER",
        help="a recording with the same robot and cameras, which says what the columns are if meta/info.json is lost",
    )
    command.set_defaults(stopped="run it again to finish")


def _run(options: argparse.Namespace) -> int:
    print(repair(root_of(options), options.info.expanduser() if options.info is not None else None))
    return 0
