"""What the commands of `bhd-data` share: how one is added, and how a dataset is named."""

import argparse
from collections.abc import Callable
from pathlib import Path

from bhd_lerobot.data.identity import default_root

type Commands = argparse._SubParsersAction[argparse.ArgumentParser]
"""Where commands are added: what `ArgumentParser.add_subparsers` returns."""

type Run = Callable[[argparse.Namespace], int]
"""Carries a command out and returns the exit status."""


def add_command(
    commands: Commands, name: str, help_text: str, run: Run, *, names_dataset: bool = True
) -> argparse.ArgumentParser:
    """Add a command.

    Args:
        commands: to these.
        name: what the user types.
        help_text: one line.
        run: what carries it out. Where Ctrl-C does not leave everything as it was, set the default ``stopped``.
        names_dataset: whether it is told one dataset, as a folder or by name; `root_of` reads it.

    Returns:
        Its parser, for its own arguments.
    """
    command = commands.add_parser(name, help=help_text, description=help_text)
    command.set_defaults(run=run, stopped="nothing was changed")
    if names_dataset:
        command.add_argument("root", nargs="?", type=Path, help="folder of the dataset")
        command.add_argument("--root", dest="root_option", type=Path, help="the same, as an option")
        command.add_argument("--repo_id", help="name of the dataset, to find it in LeRobot's default place")
        command.set_defaults(usage_error=command.error)
    return command


def root_of(options: argparse.Namespace) -> Path:
    """Return the folder of the dataset that was named; end with a usage error if none was."""
    root: Path | None = options.root or options.root_option
    if root is not None:
        return root.expanduser()
    if options.repo_id is None:
        options.usage_error("name the dataset: its folder, or --repo_id")
    return default_root(options.repo_id)
