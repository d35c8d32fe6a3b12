"""Copy a dataset to the Hub or below a URL: what differs, and nothing else."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from bhd_lerobot.data import layout
from bhd_lerobot.data.assemble import EDITS
from bhd_lerobot.data.card import is_generated
from bhd_lerobot.data.edits import edits_of
from bhd_lerobot.data.remote import CARD, PICTURE, Item, Remote, RemoteFile, is_recorded, refuse_overlap, total
from bhd_lerobot.data.remote_local import LocalDataset, open_local
from bhd_lerobot.data.remote_pool import run_all
from bhd_lerobot.data.state import DatasetState
from bhd_lerobot.errors import DatasetError, DatasetExistsError


@dataclass(frozen=True)
class Card:
    """A generated card.

    Attributes:
        text: Markdown, signed.
        picture: a PNG file's bytes; None if there is none.
    """

    text: str
    picture: bytes | None = None


type MakeCard = Callable[[DatasetState], Card]


@dataclass(frozen=True)
class PushReport:
    """What a push did.

    Attributes:
        name: where the dataset lies now.
        episodes: episodes it holds.
        sent: files that were sent.
        sent_bytes: their bytes.
        kept: files that were there already.
        deleted: files that belonged to no episode any more and were removed there.
        left_out: files on this machine that belong to no episode and were not sent.
        kept_card: whether a card that somebody edited was left as it is.
    """

    name: str
    episodes: int
    sent: list[str] = field(default_factory=list)
    sent_bytes: int = 0
    kept: int = 0
    deleted: list[str] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)
    kept_card: bool = False


def push(
    root: Path | str,
    remote: Remote,
    *,
    make_card: MakeCard | None = None,
    replace_card: bool = False,
    replace: bool = False,
) -> PushReport:
    """Make a remote dataset the same as the one on this machine.

    The dataset on this machine is not changed. A card that a person wrote is kept: one beside the dataset on this
    machine is sent instead of the generated one, and one at the remote place is left as it is.

    Args:
        root: the dataset.
        remote: where to.
        make_card: generates a card; None sends none but the user's own.
        replace_card: overwrite a card at the remote place that a person wrote.
        replace: overwrite a dataset at the remote place that is another one, or has more episodes.

    Raises:
        DatasetExistsError: there is another dataset, or one with more episodes, and `replace` is false.
        ConfigError: both are the same folder.
        DatasetError: the dataset is not whole and finalised, is in use, or was changed meanwhile.
        TransferError: the place cannot be reached or does not let this user write; what was sent is not sent again.
    """
    refuse_overlap(Path(root), remote)
    with open_local(Path(root)) as local:
        there = remote.files()
        if not replace and layout.INFO in there:
            _refuse_another(local, remote)
        cards, kept_card = _cards(local, remote, make_card, replace_card, is_there=CARD in there)
        items = [item for item in local.items if item.path not in (CARD, PICTURE)] + cards
        try:
            changed = _changed(items, there)
        except OSError as error:
            raise DatasetError(f"{root} cannot be read: {error}.") from error
        wanted = {item.path for item in items}
        ours = (layout.STATS, layout.TASKS, layout.IDENTITY, EDITS)
        deleted = sorted(path for path in there if path not in wanted and (is_recorded(path) or path in ours))
        remote.send(changed, deleted, local.check_unchanged)
        return PushReport(
            name=remote.name,
            episodes=local.state.num_episodes,
            sent=[item.path for item in changed],
            sent_bytes=total(changed),
            kept=len(items) - len(changed),
            deleted=deleted,
            left_out=local.left_out,
            kept_card=kept_card,
        )


def _refuse_another(local: LocalDataset, remote: Remote) -> None:
    """Refuse to overwrite what this dataset is no later version of; a store keeps no history.

    Raises:
        DatasetExistsError: what lies there has other columns, another rate or robot or format, or more episodes, though
            none was deleted here.
    """
    info = local.state.info
    try:
        there = json.loads(remote.read(layout.INFO) or b"{}")
        columns = {key: feature["dtype"] for key, feature in there["features"].items()}
        told = (columns, there["fps"], there.get("robot_type"), str(there["codebase_version"])[:2])
        episodes = int(there["total_episodes"])
    except (ValueError, KeyError, TypeError, AttributeError):
        told, episodes = ({}, None, None, ""), 0
    own = {key: feature["dtype"] for key, feature in info["features"].items()}
    if told != (own, info["fps"], info.get("robot_type"), str(info["codebase_version"])[:2]):
        raise DatasetExistsError(
            f"{remote.name} is another dataset: it has other columns, another rate, robot or format than {local.root}. "
            "Choose another place, or give up what lies there with --replace."
        )
    if episodes > local.state.num_episodes and not any(edit.get("edit") == "delete" for edit in edits_of(local.root)):
        raise DatasetExistsError(
            f"{remote.name} has {episodes} episodes, {local.root} has {local.state.num_episodes} and none was deleted "
            "from it: it is an older one, or another. Pull that one, or give it up with --replace."
        )


def _changed(items: Sequence[Item], there: Mapping[str, RemoteFile]) -> list[Item]:
    same: set[str] = set()

    def compare(item: Item) -> None:
        if item.is_like(there.get(item.path)):
            same.add(item.path)

    run_all(compare, items)
    return [item for item in items if item.path not in same]


def _cards(
    local: LocalDataset, remote: Remote, make_card: MakeCard | None, replace: bool, *, is_there: bool
) -> tuple[list[Item], bool]:
    """Return the card and its picture as files to send, and whether a person's card is left as it is there."""
    own = {item.path: item for item in local.items if item.path in (CARD, PICTURE)}
    mine = (local.root / CARD).read_bytes() if CARD in own else b""
    is_mine = bool(mine) and not is_generated(_text(mine))
    theirs = remote.read(CARD) if is_there and not replace else None
    if theirs is not None and not is_generated(_text(theirs)) and not (is_mine and theirs == mine):
        return [], True
    if is_mine:
        return list(own.values()), False
    if make_card is None:
        return [], False
    card = make_card(local.state)
    contents = {CARD: card.text.encode(), PICTURE: card.picture}
    return [Item(path, content, len(content)) for path, content in contents.items() if content is not None], False


def _text(content: bytes) -> str:
    return content.decode("utf-8", errors="replace")
