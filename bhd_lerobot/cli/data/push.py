"""`bhd-data push`: a dataset to the Hub, or below a URL."""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from bhd_lerobot.cli.data.command import Commands, add_command
from bhd_lerobot.datasets.format.identity import default_root
from bhd_lerobot.datasets.remote.listing import check_repo_id, counted, is_url, listed, megabytes
from bhd_lerobot.datasets.remote.url import check_url
from bhd_lerobot.errors import BhdError, ConfigError
from bhd_lerobot.hub.transfer import (
    command_line,
    folder_of,
    for_urls,
    prompt_interrupt,
    quiet_bars,
    refuse_empty,
    repeat_line,
    split_list,
    storage_options,
    tell_of_folder,
)

if TYPE_CHECKING:
    from bhd_lerobot.datasets.remote.push import PushReport


def add_to(commands: Commands) -> None:
    """Add `push`."""
    help_text = "upload a dataset to the Hub or below a URL: what differs, with a card; repeat it to go on"
    command = add_command(commands, "push", help_text, _run, names_dataset=False)
    command.add_argument("places", nargs="*", metavar="ROOT [TARGET]", help="folder; user/name on the Hub, or a URL")
    command.add_argument("--root", help="the folder, as an option; LeRobot's default place of the name if nothing")
    command.add_argument("--repo_id", help="the name on the Hub, as an option")
    command.add_argument("--branch", "--revision", help="branch to write to; it is made if it does not exist")
    command.add_argument("--tag", help="a further tag for what is pushed")
    seen = command.add_mutually_exclusive_group()
    seen.add_argument("--private", action="store_true", help="a repository for you alone")
    seen.add_argument("--public", action="store_true", help="a repository for everybody")
    command.add_argument("--tags", help="tags of the card, separated by commas")
    command.add_argument("--licence", "--license", default="apache-2.0", help="licence of the card")
    command.add_argument(
        "--no_card", "--no-card", action="store_true", help="send no card but one that lies in the folder"
    )
    command.add_argument(
        "--replace_card", "--replace-card", action="store_true", help="overwrite a card there that somebody edited"
    )
    command.add_argument(
        "--replace", action="store_true", help="overwrite a dataset there that is another one, or has more episodes"
    )
    command.add_argument(
        "--verify", action="store_true", help="of a URL: read what is there, and compare that instead of the list of it"
    )
    command.add_argument("--storage_options", help="options of the URL's file system, JSON")


def _run(options: argparse.Namespace) -> int:
    root, target = _places(options)
    again = repeat_line(options, root, target)
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
            replace_card=options.replace_card,
            replace=options.replace,
            verify=options.verify,
            storage=options.storage_options,
            again=again,
        )
    print(tell(report))
    return 0


def push_dataset(
    root: Path,
    target: str,
    *,
    branch: str | None = None,
    tag: str | None = None,
    private: bool | None = None,
    tags: Sequence[str] = (),
    licence: str = "apache-2.0",
    card: bool = True,
    replace_card: bool = False,
    replace: bool = False,
    verify: bool = False,
    storage: str | None = None,
    again: str | None = None,
) -> "PushReport":
    """Upload a dataset, with its card.

    Args:
        root: the dataset.
        target: name on the Hub, or a URL.
        branch: branch of the Hub to write to; the main one if None.
        tag: a further tag for what is pushed.
        private: whether a repository that is made is private; None leaves it to the Hub.
        tags: tags of the card.
        licence: licence of the card.
        card: whether a card is made.
        replace_card: overwrite a card that a person edited.
        replace: overwrite a dataset there that is another one, or has more episodes.
        verify: read what lies below a URL and compare that, instead of the list of it.
        storage: options of the URL's file system, JSON.
        again: the command to repeat.

    Raises:
        BhdError: it was not uploaded; the message says why, that the dataset is kept, and how to repeat.
    """
    from bhd_lerobot.datasets.format.state import DatasetState
    from bhd_lerobot.datasets.remote.hub import HubDataset
    from bhd_lerobot.datasets.remote.push import Card, push
    from bhd_lerobot.datasets.remote.store import StoreDataset
    from bhd_lerobot.datasets.remote.url import shown

    def make(state: DatasetState, has_picture: bool) -> Card:
        from bhd_lerobot.hub.card import CardOptions, make_card

        named = None if is_url(target) else target
        return make_card(
            state, CardOptions(named, "" if named else shown(target), licence, tags), has_picture=has_picture
        )

    again = again or push_command(root, target, private=private is True, tags=tags)
    quiet_bars()
    try:
        remote = (
            StoreDataset(target, storage_options(storage))
            if is_url(target)
            else HubDataset(target, branch, private=private, tag=tag, create=True)
        )
        return push(
            root,
            remote,
            make_card=make if card else None,
            replace_card=replace_card,
            replace=replace,
            verify=verify,
        )
    except ConfigError:
        raise
    except BhdError as error:
        kept = f"The dataset at {root} is unchanged" if Path(root).exists() else "Nothing was sent"
        raise type(error)(f"{error}\n{kept}. When that is mended, repeat:\n  {again}") from error


def push_command(root: Path, target: str, *, private: bool = False, tags: Sequence[str] = ()) -> str:
    """Return the command that uploads a dataset."""
    return command_line("push", [root, target], private=private, tags=list(tags))


def left_by_interrupt(root: Path, again: str) -> str:
    """Return what an interrupted push leaves, and how to go on."""
    return f"the dataset at {root} is unchanged, and what arrived is not sent again. Go on with:\n  {again}"


def check_pushable(repo_id: str) -> None:
    """Check what can be checked without asking the Hub: the name, and that there is a token.

    Raises:
        BhdError: says what is missing.
    """
    from bhd_lerobot.datasets.remote.hub_errors import require_token

    require_token(check_repo_id(repo_id))


def tell(report: "PushReport") -> str:
    """Return a report for a terminal."""
    lines = [f"{report.name}: {report.episodes} episodes"]
    if report.sent:
        lines.append(f"  sent {counted(report.sent)}, {megabytes(report.sent_bytes)}; {report.kept} were there already")
    elif not report.deleted:
        lines.append(f"  nothing to send: all {report.kept} files are there")
    if report.deleted:
        lines.append(f"  removed there, because no episode needs them: {listed(report.deleted)}")
    if report.left_out:
        lines.append(f"  not sent, because no episode needs them: {listed(report.left_out)}")
    if report.kept_card:
        lines.append("  its README.md was edited by somebody and is left as it is; --replace_card writes a new one")
    if report.kept_picture:
        lines.append("  its preview.png was put there by somebody and is left as it is; --replace_card overwrites it")
    return "\n".join(lines)


def _places(options: argparse.Namespace) -> tuple[Path, str]:
    """Return the folder and the target that were named in one way or another.

    Raises:
        ConfigError: one is missing, or named twice.
    """
    refuse_empty(options)
    places = list(options.places)
    if places and options.root is None and not is_url(places[0]):
        options.root = places.pop(0)
    if places and options.repo_id is None:
        options.repo_id = places.pop(0)
    if places:
        raise ConfigError(f"{' '.join(places)} is too much; give the folder and one target.")
    target = options.repo_id
    if target is None:
        raise ConfigError(
            "Say where to: bhd-data push ROOT user/name for the Hub, or bhd-data push ROOT s3://bucket/dir for a URL."
        )
    if is_url(target):
        check_url(target)
        if options.branch or options.tag or options.private or options.public:
            raise ConfigError(f"{target} is a URL: it has no branches, tags or privacy of its own.")
        if options.root is None:
            raise ConfigError("Name the folder of the dataset first: bhd-data push ROOT URL.")
        return folder_of(options.root), target
    check_repo_id(target)
    for_urls(options)
    root = folder_of(options.root) if options.root else default_root(target)
    tell_of_folder(target, root)
    return root, target
