"""What the commands of `bhd-data` share: how one is added, and how a dataset is named."""

import argparse
from collections.abc import Callable
from pathlib import Path

from bhd_lerobot.datasets.format.identity import default_root

type Commands = argparse._SubParsersAction[argparse.ArgumentParser]
"""Where commands are added: what `ArgumentParser.add_subparsers` returns."""

type Run = Callable[[argparse.Namespace], int]
"""Carries a command out and returns the exit status."""


def add_command(
    commands: Commands, name: str, help_text: str, run: Run, *, names_dataset: bool = True, takes_several: bool = False
) -> argparse.ArgumentParser:
    """Add a command; where Ctrl-C does not leave everything as it was, set its default ``stopped``."""
    command = commands.add_parser(name, help=help_text, description=help_text)
    command.set_defaults(run=run, stopped="nothing was changed", command_parser=command)
    if names_dataset:
        text = "folder of the dataset" + ("; several may be named" if takes_several else "")
        command.add_argument("root", metavar="ROOT", nargs="*" if takes_several else "?", type=Path, help=text)
        command.add_argument("--root", dest="root_option", metavar="ROOT", type=Path, help="the same, as an option")
        text = "instead of the folder: the dataset's name, user/name, in LeRobot's default place"
        command.add_argument("--repo_id", metavar="NAME", help=text)
    return command


def root_of(options: argparse.Namespace) -> Path:
    """Return the folder of the dataset that was named; end with a usage error if none was, or more than one."""
    return roots_of(options)[0]


def roots_of(options: argparse.Namespace) -> list[Path]:
    """Return the folders of the datasets that were named; end with a usage error if none was, or in several ways."""
    folders = options.root if isinstance(options.root, list) else [options.root] if options.root is not None else []
    named = {
        "ROOT": " ".join(map(str, folders)) if folders else None,
        "--root": options.root_option,
        "--repo_id": options.repo_id,
    }
    given = {option: value for option, value in named.items() if value is not None}
    if len(given) != 1:
        options_given = " and ".join(f"{option} {value}" for option, value in given.items())
        options.command_parser.error(
            f"name the dataset, in one way: its folder (ROOT or --root), or --repo_id; got {options_given or 'none'}"
        )
    if options.repo_id is not None:
        return [default_root(options.repo_id)]
    return [folder.expanduser() for folder in folders or [options.root_option]]
