"""`bhd-data push`: a dataset to the Hub, or below a URL."""

import argparse
from pathlib import Path

from bhd_lerobot.cli.data.command import Commands, add_command
from bhd_lerobot.datasets.format.identity import default_root
from bhd_lerobot.datasets.remote.place import check_repo_id, is_url
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.hub.push import format_push_report, left_by_interrupt, push_dataset
from bhd_lerobot.hub.transfer import (
    again_line,
    folder_of,
    prompt_interrupt,
    refuse_empty,
    split_list,
    warn_of_folder,
)


def add_to(commands: Commands) -> None:
    """Add `push`."""
    help_text = "upload a dataset to the Hub or below a URL, with a card; to the Hub only what differs"
    command = add_command(commands, "push", help_text, _run, names_dataset=False)
    command.add_argument("places", nargs="*", metavar="ROOT [TARGET]", help="folder; user/name on the Hub, or a URL")
    command.add_argument("--root", help="the folder, as an option; LeRobot's default place of the name if not set")
    command.add_argument("--repo_id", help="the name on the Hub, as an option")
    command.add_argument("--branch", "--revision", help="branch to write to; created if it does not exist")
    command.add_argument("--tag", help="a further tag for what is pushed")
    seen = command.add_mutually_exclusive_group()
    seen.add_argument("--private", action="store_true", help="a private repository")
    seen.add_argument("--public", action="store_true", help="a public repository")
    command.add_argument("--tags", help="tags of the card, separated by commas")
    command.add_argument("--licence", "--license", default="apache-2.0", help="licence of the card")
    command.add_argument(
        "--no_card", "--no-card", action="store_true", help="upload no card, except a README.md in the folder"
    )
    command.add_argument(
        "--replace",
        action="store_true",
        help="overwrite the target, even if it is another dataset or has more episodes",
    )
    command.add_argument("--storage_options", help="options of the URL's file system, JSON")


def _run(options: argparse.Namespace) -> int:
    root, target = _places(options)
    again = again_line(options)
    options.stopped = left_by_interrupt(root, again)
    with prompt_interrupt(options.stopped):
        report = push_dataset(
            root,
            target,
            branch=options.branch,
            tag=options.tag,
            private=True if options.private else False if options.public else None,
            tags=split_list(options.tags),
            licence=options.licence,
            card=not options.no_card,
            replace=options.replace,
            storage=options.storage_options,
            again=again,
        )
    print(format_push_report(report))
    return 0


def _places(options: argparse.Namespace) -> tuple[Path, str]:
    """Return the folder and the target that were named in one way or another."""
    refuse_empty(options)
    places = list(options.places)
    if places and options.root is None and not is_url(places[0]):
        options.root = places.pop(0)
    if places and options.repo_id is None:
        options.repo_id = places.pop(0)
    if places:
        raise ConfigError(f"Unexpected argument: {' '.join(places)}. Give the folder and one target.")
    target = options.repo_id
    if target is None:
        raise ConfigError(
            "Give the target: bhd-data push ROOT user/name for the Hub, or bhd-data push ROOT s3://bucket/dir for a "
            "URL."
        )
    if is_url(target):
        if options.branch or options.tag or options.private or options.public:
            raise ConfigError(f"{target} is a URL: it has no branches, tags or privacy of its own.")
        if options.root is None:
            raise ConfigError("Name the folder of the dataset first: bhd-data push ROOT URL.")
        return folder_of(options.root), target
    check_repo_id(target)
    root = folder_of(options.root) if options.root else default_root(target)
    warn_of_folder(target, root)
    return root, target
