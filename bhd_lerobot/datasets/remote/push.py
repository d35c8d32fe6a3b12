"""Copy a dataset to the Hub or below a URL: what differs, and nothing else."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from bhd_lerobot.datasets.assembly.assemble import EDITS
from bhd_lerobot.datasets.edit.edits import edits_of
from bhd_lerobot.datasets.format.state import DatasetState
from bhd_lerobot.datasets.remote.card import is_generated
from bhd_lerobot.datasets.remote.listing import (
    CARD,
    LISTED,
    MANIFEST,
    PICTURE,
    Item,
    Remote,
    RemoteFile,
    is_recorded,
    parse_info,
    refuse_overlap,
    total,
)
from bhd_lerobot.datasets.remote.local import LocalDataset, open_local
from bhd_lerobot.datasets.remote.pool import run_all
from bhd_lerobot.datasets.storage import layout
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


type MakeCard = Callable[[DatasetState, bool], Card]
"""Makes a card of a dataset, given whether there is a picture already that a person put there."""


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
        kept_picture: whether a picture that somebody put there was left as it is.
    """

    name: str
    episodes: int
    sent: list[str] = field(default_factory=list)
    sent_bytes: int = 0
    kept: int = 0
    deleted: list[str] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)
    kept_card: bool = False
    kept_picture: bool = False


def push(
    root: Path | str,
    remote: Remote,
    *,
    make_card: MakeCard | None = None,
    replace_card: bool = False,
    replace: bool = False,
    verify: bool = False,
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
        verify: read what lies at the remote place and compare that, instead of what is listed about it.

    Raises:
        DatasetExistsError: there is another dataset, or one with more episodes, and `replace` is false.
        ConfigError: both are the same folder, or the place needs no verifying.
        DatasetError: the dataset is not whole and finalised, is in use, or was changed meanwhile.
        TransferError: the place cannot be reached or does not let this user write; what was sent is not sent again.
    """
    refuse_overlap(Path(root), remote)
    with open_local(Path(root)) as local:
        there = remote.files()
        if not replace:
            _refuse_another(local, remote, there)
        cards, kept = _cards(local, remote, make_card, replace_card, there)
        items = [item for item in local.items if item.path not in (CARD, PICTURE)] + cards
        try:
            if verify:
                there |= remote.verified([one.path for one in items if _may_be(one, there.get(one.path))])
            changed = _changed(items, there)
        except OSError as error:
            raise DatasetError(f"{root} cannot be read: {error}.") from error
        wanted = {item.path for item in items}
        ours = (layout.STATS, layout.TASKS, layout.IDENTITY, EDITS, MANIFEST)
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
            kept_card=CARD in kept,
            kept_picture=PICTURE in kept,
        )


def _may_be(item: Item, file: RemoteFile | None) -> bool:
    return file is not None and file.size == item.size


def _refuse_another(local: LocalDataset, remote: Remote, there: Mapping[str, RemoteFile]) -> None:
    """Refuse to overwrite what this dataset is no later version of; a store keeps no history.

    Raises:
        DatasetExistsError: what lies there has other columns, another rate or robot or format, or more episodes than
            were deleted here since; or it is no dataset of this format at all. If a push to there did not end, what was
            there before it counts.
    """
    is_shown = layout.INFO in there
    if is_shown and next(item for item in local.items if item.path == layout.INFO).is_like(there[layout.INFO]):
        return  # whatever became of it there since: this dataset is what was put there
    content = remote.read(layout.INFO) if is_shown else remote.former_info()
    if content is None and not is_shown:
        return
    name = remote.name if is_shown else f"{remote.name}, before a push to it that did not end,"
    try:
        found = parse_info(content, name)
    except DatasetError as error:
        raise DatasetExistsError(f"{error} Choose another place, or give up what lies there with --replace.") from error
    if _kind(found) != _kind(local.state.info):
        raise DatasetExistsError(
            f"{name} {'is' if is_shown else 'was'} another dataset: it has other columns, another rate, robot or "
            f"format than {local.root}. Choose another place, or give up what lies there with --replace."
        )
    here, episodes = local.state.num_episodes, found["total_episodes"]
    if episodes <= here:
        return
    deleted = _deleted_since(local.root, remote.read(EDITS) if EDITS in there else b"")
    if episodes > here + deleted:
        has, remedy = ("has", "Pull that one") if is_shown else ("had", "Repeat that push")
        since = f"{deleted} {'were' if deleted > 1 else 'was'}" if deleted else "none was"
        raise DatasetExistsError(
            f"{name} {has} {episodes} episodes, {local.root} has {here} and {since} deleted from it since: it is an "
            f"older one, or another. {remedy}, or give it up with --replace."
        )


def _deleted_since(root: Path, there: bytes | None) -> int:
    """Return how many episodes were deleted from a dataset since a copy of it was made.

    Args:
        root: the dataset.
        there: the list of edits of the copy.
    """
    try:
        edits, former = edits_of(root), [json.loads(line) for line in (there or b"").splitlines()]
        known = len(former) if edits[: len(former)] == former else 0
        return sum(len(edit["episodes"]) for edit in edits[known:] if edit["edit"] == "delete")
    except (OSError, ValueError, KeyError, TypeError):
        return 0  # nobody knows, so none


def _kind(info: Mapping[str, Any]) -> tuple[Any, ...]:
    columns = {key: feature["dtype"] for key, feature in info["features"].items()}
    return columns, info["fps"], info.get("robot_type"), str(info["codebase_version"])[:2]


def _changed(items: Sequence[Item], there: Mapping[str, RemoteFile]) -> list[Item]:
    same: set[str] = set()

    def compare(item: Item) -> None:
        if item.is_like(there.get(item.path)):
            same.add(item.path)

    run_all(compare, items)
    return [item for item in items if item.path not in same]


def _cards(
    local: LocalDataset,
    remote: Remote,
    make_card: MakeCard | None,
    replace: bool,
    there: Mapping[str, RemoteFile],
) -> tuple[list[Item], set[str]]:
    """Return the card and its picture as files to send, and which of both are a person's there and left as they are."""
    own = {item.path: item for item in local.items if item.path in (CARD, PICTURE)}
    mine = (local.root / CARD).read_bytes() if CARD in own else b""
    is_mine = bool(mine) and not is_generated(_text(mine))
    theirs = remote.read(CARD) if CARD in there and not replace else None
    if theirs is not None and not is_generated(_text(theirs)) and not (is_mine and theirs == mine):
        return [], {CARD}
    if is_mine:
        return list(own.values()), set()
    # A generated card and its picture come together. A picture alone is a person's, at either end.
    picture = own.get(PICTURE) if CARD not in own else None
    is_theirs = PICTURE in there and CARD not in there and not replace and there[PICTURE].algorithm != LISTED
    kept = {PICTURE} if is_theirs and not (picture and picture.is_like(there[PICTURE])) else set()
    if make_card is None:
        return [picture] if picture and not kept else [], kept if picture else set()
    card = make_card(local.state, picture is not None or bool(kept))
    items = [Item(CARD, text := card.text.encode(), len(text))]
    if kept:
        return items, kept
    if picture is not None:
        return [*items, picture], set()
    if card.picture is not None:
        items.append(Item(PICTURE, card.picture, len(card.picture)))
    return items, set()


def _text(content: bytes) -> str:
    return content.decode("utf-8", errors="replace")
