"""`bhd-data repair`: complete or drop what an interruption left."""

import argparse

from bhd_lerobot.data.repair import repair
from bhd_lerobot.runs.data_command import Commands, add_command, root_of


def add_to(commands: Commands) -> None:
    """Add `repair`."""
    help_text = "complete or drop what an interrupted recording left, and leave the dataset compact"
    command = add_command(commands, "repair", help_text, _run)
    command.set_defaults(stopped="run it again to finish")


def _run(options: argparse.Namespace) -> int:
    print(repair(root_of(options)))
    return 0
