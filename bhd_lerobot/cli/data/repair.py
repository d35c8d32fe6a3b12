"""`bhd-data repair`: finish or drop what an interruption left, and recover what is whole."""

import argparse
from pathlib import Path

from bhd_lerobot.cli.data.command import Commands, add_command, root_of
from bhd_lerobot.datasets.recovery.repair import repair


def add_to(commands: Commands) -> None:
    """Add `repair`."""
    help_text = "complete interrupted changes, recover the intact episodes of damaged files, and compact the dataset"
    command = add_command(commands, "repair", help_text, _run)
    command.add_argument(
        "--info",
        type=Path,
        metavar="OTHER",
        help="a recording with the same robot and cameras, which describes the columns if meta/info.json is lost",
    )
    command.set_defaults(stopped="run it again to finish")


def _run(options: argparse.Namespace) -> int:
    print(repair(root_of(options), options.info.expanduser() if options.info is not None else None))
    return 0
