"""Uploading a dataset with its card, and what is said of it."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from bhd_lerobot.datasets.remote.listing import check_repo_id, counted, is_url, listed, megabytes
from bhd_lerobot.errors import BhdError, ConfigError
from bhd_lerobot.hub.transfer import command_line, quiet_bars, storage_options

if TYPE_CHECKING:
    from bhd_lerobot.datasets.remote.push import PushReport


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
