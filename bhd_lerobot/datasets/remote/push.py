"""Copy a dataset to the Hub or below a URL: what differs, and nothing else."""

import contextlib
import hashlib
import re
import tempfile
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from bhd_lerobot.datasets.assembly.assemble import EDITS
from bhd_lerobot.datasets.format.episode_table import read_stats
from bhd_lerobot.datasets.format.identity import as_text, conflicts
from bhd_lerobot.datasets.format.info import InfoError, parse_object
from bhd_lerobot.datasets.format.state import UNREADABLE, DatasetState
from bhd_lerobot.datasets.remote.listing import CARD, PREVIEW, RemoteFile, is_recorded, matching, parse_info
from bhd_lerobot.datasets.remote.local import LocalDataset, open_local
from bhd_lerobot.datasets.remote.store import Remote, refuse_overlap
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.errors import DatasetError, DatasetExistsError, brief

_SIGNATURE = re.compile(r"\n<!-- bhd-card ([0-9a-f]{64}) -->\n\Z")
_EPISODES = "meta/episodes/"


@dataclass(frozen=True)
class Card:
    """A generated card: Markdown, signed by `sign`, and a PNG file's bytes if it shows an image."""

    text: str
    image: bytes | None = None


type MakeCard = Callable[[DatasetState, bool], Card]
"""Makes a card of a dataset, given whether the user has put an image beside it."""


@dataclass(frozen=True)
class PushReport:
    """What a push did: files that were sent, there already (`kept`), removed there, and not sent (`left_out`).

    `kept_card` reports whether a card there that was not generated is left as it is.
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
    replace: bool = False,
) -> PushReport:
    """Make a remote dataset the same as the one on this machine, which is not changed.

    A `README.md` in the folder is its card. Without one a card is generated, unless there is one that was not.
    """
    refuse_overlap(Path(root), remote)
    with open_local(Path(root)) as local, tempfile.TemporaryDirectory() as scratch:
        there = remote.files()
        if not replace:
            _refuse_another(local, remote, there)
        card, kept_card = _card(local, remote, make_card, there, Path(scratch))
        files = {path: file for path, file in local.files.items() if path not in (CARD, PREVIEW)} | card
        try:
            same = matching(files, there) if remote.has_checksums else set()
        except OSError as error:
            raise DatasetError(f"{root} cannot be read: {error}.") from error
        changed = {path: file for path, file in files.items() if path not in same}
        ours = (layout.STATS, layout.TASKS, layout.IDENTITY, EDITS)
        deleted = sorted(path for path in there if path not in files and (is_recorded(path) or path in ours))
        remote.send(changed, deleted, local.check_unchanged)
        return PushReport(
            name=remote.name,
            episodes=local.state.num_episodes,
            sent=list(changed),
            sent_bytes=sum(file.stat().st_size for file in changed.values()),
            kept=len(same),
            deleted=deleted,
            left_out=local.left_out,
            kept_card=kept_card,
        )


def sign(text: str) -> str:
    """Return the text of a generated card with the checksum of itself at its end."""
    return f"{text}\n<!-- bhd-card {hashlib.sha256(text.encode()).hexdigest()} -->\n"


def is_generated(content: bytes) -> bool:
    """Return whether a card was signed by `sign`, and not edited since."""
    text = content.decode(errors="replace").replace("\r\n", "\n")
    found = _SIGNATURE.search(text)
    return found is not None and hashlib.sha256(text[: found.start()].encode()).hexdigest() == found[1]


def _card(
    local: LocalDataset, remote: Remote, make_card: MakeCard | None, there: Mapping[str, RemoteFile], scratch: Path
) -> tuple[dict[str, Path], bool]:
    """Return the card and its image as files to send, and whether a card there is not generated, and so kept."""
    own = {path: local.files[path] for path in (CARD, PREVIEW) if path in local.files}
    if CARD in own:
        if not is_generated(own[CARD].read_bytes()):
            return own, False
        own = {}  # both were generated, and came with a pull
    if CARD in there and not is_generated(remote.read(CARD)):
        return {}, True
    if make_card is not None:
        card = make_card(local.state, PREVIEW in own)
        content = {CARD: card.text.encode(), PREVIEW: card.image}
        for path, one in content.items():
            if one is not None:
                (scratch / path).write_bytes(one)
                own.setdefault(path, scratch / path)
    return own, False


def _refuse_another(local: LocalDataset, remote: Remote, there: Mapping[str, RemoteFile]) -> None:
    """Refuse to overwrite what this dataset is no later version of; a store keeps no history."""
    name, remedy = remote.name, "or overwrite it with --replace."
    if layout.INFO not in there:
        return
    info, identity, edits = (_other(local, remote, there, path) for path in (layout.INFO, layout.IDENTITY, EDITS))
    try:
        found = local.state.info if info is None else parse_info(info, name)
    except DatasetError as error:
        raise DatasetExistsError(f"{error} Choose another place, {remedy}") from error
    if _kind(found) != _kind(local.state.info):
        raise DatasetExistsError(
            f"{name} is another dataset: it has other columns, another rate, robot or format than {local.root}. Choose "
            f"another place, {remedy}"
        )
    if found["total_episodes"] > local.state.num_episodes:
        raise DatasetExistsError(
            f"{name} has {found['total_episodes']} episodes, {local.root} has {local.state.num_episodes}: it is an "
            f"older one, or another, or some were deleted. Pull that one, or complete that push, {remedy}"
        )
    if conflicts := _conflicts(identity, local.state.identity):
        raise DatasetExistsError(
            f"{name} is another recording than {local.root}: {brief(conflicts, 3)}. Choose another place, {remedy}"
        )
    if (episode := _other_episode(local, remote, there)) is not None:
        raise DatasetExistsError(
            f"{name} is another recording than {local.root}, with the same options: episode {episode} has other frames "
            f"there. Choose another place, {remedy}"
        )
    own = local.files[EDITS].read_bytes().splitlines() if EDITS in local.files else []
    if lost := [line for line in (edits or b"").splitlines() if line not in own]:
        raise DatasetExistsError(
            f"{name} was edited or marked, and {local.root} was not: {lost[0].decode(errors='replace'):.120}. Pull "
            f"that one, {remedy}"
        )


def _other(local: LocalDataset, remote: Remote, there: Mapping[str, RemoteFile], path: str) -> bytes | None:
    """Return the content of a file of a remote dataset; None if there is none, or if it is known to be that here."""
    file = there.get(path)
    if file is None or (file.digest is not None and path in local.files and file.matches(local.files[path])):
        return None
    return remote.read(path)


def _other_episode(local: LocalDataset, remote: Remote, there: Mapping[str, RemoteFile]) -> int | None:
    """Return the first episode that has other frames there than here; None if none is known to have."""
    paths = [path for path in there if path.startswith(_EPISODES) and is_recorded(path)]
    theirs = _limits(content for path in paths if (content := _other(local, remote, there, path)) is not None)
    if not theirs:
        return None
    ours = _limits(file.read_bytes() for path, file in local.files.items() if path.startswith(_EPISODES))
    for episode in sorted(theirs.keys() & ours.keys()):
        if any(ours[episode].get(name, value) != value for name, value in theirs[episode].items()):
            return episode
    return None


def _limits(files: Iterable[bytes]) -> dict[int, dict[str, Any]]:
    """Return the length of each episode in files of `meta/episodes`, and the limits of what was observed and done.

    By these the frames are known: marks do not change them, nor does a program that computes statistics anew.
    """
    known: dict[int, dict[str, Any]] = {}
    for content in files:
        with contextlib.suppress(*UNREADABLE, KeyError):  # damaged there: nothing is known of it
            file = pq.ParquetFile(pa.BufferReader(content))
            rows, stats = file.read(columns=["episode_index", "length"]).to_pylist(), read_stats(file)
            learned = [(key, stat) for key, stat in stats.items() if key.startswith(("observation", "action"))]
            for place, row in enumerate(rows):
                known[row["episode_index"]] = {"length": row["length"]} | {
                    f"{key} {name}": (stat[name][place] + 0.0).astype(np.float32).tobytes()  # -0 is 0
                    for key, stat in learned
                    for name in ("min", "max")
                    if stat[name].ndim == 2  # of an image they are those of a sample
                }
    return known


def _conflicts(theirs: bytes | None, ours: Mapping[str, Any] | None) -> list[str]:
    """Return what two recordings state differently; what only one states, such as one that was merged, is none."""
    try:
        there, here = dict(parse_object(theirs or b"{}")["recording"]), dict((ours or {})["recording"])
    except (InfoError, KeyError, TypeError, ValueError):
        return []  # one of another program
    found = conflicts("", {**there, "edited": None}, {**here, "edited": None})
    return [f"{name}: there {as_text(one)}, here {as_text(other)}" for name, one, other in found]


def _kind(info: Mapping[str, Any]) -> tuple[Any, ...]:
    columns = {key: feature["dtype"] for key, feature in info["features"].items()}
    return columns, info["fps"], info.get("robot_type"), str(info["codebase_version"])[:2]
