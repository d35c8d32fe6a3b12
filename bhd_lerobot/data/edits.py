"""Other datasets out of datasets: merge several, keep some episodes, delete some, split one."""

import contextlib
import datetime
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa

from bhd_lerobot.data import exchange, layout
from bhd_lerobot.data.assemble import EDITS, assemble, check_alike
from bhd_lerobot.data.creation import build_root, refuse_inside
from bhd_lerobot.data.disk import Disk, RootLock, write_errors
from bhd_lerobot.data.identity import FORMAT
from bhd_lerobot.data.picks import Pick
from bhd_lerobot.data.state import DatasetState, load_state, no_dataset
from bhd_lerobot.errors import ConfigError, DatasetError, DatasetExistsError


@dataclass(frozen=True)
class EditReport:
    """What came out of an edit.

    Attributes:
        root: the dataset that was made or changed.
        episodes: episodes it holds now.
        frames: frames it holds now.
    """

    root: Path
    episodes: int
    frames: int

    def __str__(self) -> str:
        """Return the report for a terminal."""
        return f"{self.root}: {self.episodes} episodes, {self.frames} frames"


def merge(roots: Sequence[Path | str], target: Path | str) -> EditReport:
    """Make one dataset of all episodes of several, in their order.

    Args:
        roots: the datasets; they stay as they are.
        target: the new one; must not exist.

    Raises:
        ConfigError: fewer than two datasets, or one of them twice.
        DatasetMismatchError: they have other robots, frame rates or features.
        DatasetExistsError: `target` exists.
        DatasetLockedError: one of them is being recorded.
        DatasetError: one of them is no sound, finalised dataset, or cannot be written.
    """
    paths = [Path(root) for root in roots]
    if len(paths) < 2:
        raise ConfigError(f"Merging takes at least two datasets; got {len(paths)}.")
    resolved = [path.resolve() for path in paths]
    for path in resolved:
        if resolved.count(path) > 1:
            raise ConfigError(f"{path} is given more than once; its episodes would be in the new dataset twice.")
    with opened(paths) as states:
        check_alike(states)
        picks = [Pick(state, row) for state in states for row in state.rows]
        sizes = [{"root": state.root.name, "episodes": len(state.rows)} for state in states]
        recordings = [(state.identity or {}).get("recording", {}) for state in states]
        return _write_new(Path(target), picks, {"edit": "merge", "sources": sizes}, _common(recordings))


def keep(root: Path | str, episodes: Sequence[int], target: Path | str) -> EditReport:
    """Make a dataset of some episodes of another, which stays as it is.

    Args:
        root: the dataset.
        episodes: the wanted ones, in the wanted order.
        target: the new one; must not exist.

    Raises:
        DatasetExistsError: `target` exists.
        DatasetLockedError: `root` is being recorded.
        DatasetError: there is no such episode or no sound, finalised dataset, or it cannot be written.
    """
    with opened([Path(root)]) as (state,):
        return _keep(state, episodes, Path(target), "keep")


def split(root: Path | str, parts: Mapping[str, Sequence[int]], folder: Path | str) -> list[EditReport]:
    """Make several datasets of the episodes of one, which stays as it is.

    Args:
        root: the dataset.
        parts: the episodes of each new dataset, by its name.
        folder: where they come to lie, each under its name; none of them may exist.

    Raises:
        ConfigError: an episode is wanted in two parts.
        DatasetExistsError: one of the new datasets exists; then none is written.
        DatasetLockedError: `root` is being recorded.
        DatasetError: there is no such episode or no sound, finalised dataset, or it cannot be written.
    """
    owner: dict[int, str] = {}
    for name, episodes in parts.items():
        for episode in episodes:
            if owner.setdefault(episode, name) != name:
                raise ConfigError(f"Episode {episode} is wanted in {owner[episode]!r} and in {name!r}.")
    with opened([Path(root)]) as (state,):
        for name, episodes in parts.items():
            check_episodes(state, episodes)
            if not episodes:
                raise ConfigError(f"Part {name!r} would have no episode; {root} has {len(state.rows)}.")
            if (Path(folder) / name).exists():
                raise DatasetExistsError(f"{Path(folder) / name} exists already. Remove it, or choose another folder.")
        return [_keep(state, episodes, Path(folder) / name, "split") for name, episodes in parts.items()]


def delete(root: Path | str, episodes: Sequence[int]) -> EditReport:
    """Remove episodes from a dataset, in place; the others are numbered anew.

    A kill at any moment leaves either the old dataset or the new one.

    Args:
        root: the dataset.
        episodes: what is removed.

    Raises:
        DatasetLockedError: it is being recorded.
        DatasetError: there is no such episode or no sound, finalised dataset, no episode would be left, or the disk
            refuses.
    """
    with opened([Path(root)]) as (state,):
        check_episodes(state, episodes)
        gone = set(episodes)
        picks = [Pick(state, row) for row in state.rows if row["episode_index"] not in gone]
        edit = {"edit": "delete", "episodes": sorted(gone)}
        return rewrite(state, picks, edit, _edited(state, edit))


def rewrite(
    state: DatasetState,
    picks: Sequence[Pick],
    edit: Mapping[str, Any],
    identity: Mapping[str, Any] | None,
    types: Mapping[str, pa.DataType] | None = None,
) -> EditReport:
    """Put other content into a dataset; the caller holds its lock.

    Args:
        state: the dataset.
        picks: its new episodes.
        edit: what is told about it in ``meta/edits.jsonl``; the time is added.
        identity: new content of ``meta/bhd.json``.
        types: Arrow types of new metadata columns, by name without prefix.

    Raises:
        DatasetWriteError: the disk refuses; the dataset is as it was.
        DatasetCorruptError: one of its files cannot be read.
    """
    disk = Disk()
    with write_errors(f"{edit['edit']} episodes", state.root, "The dataset is as it was."):
        try:
            new = exchange.begin(state.root, disk)
            assemble(picks, new, disk, types=types, in_place=True, edit=_timed(edit), identity=identity)
        except BaseException:
            with contextlib.suppress(OSError):
                disk.remove_tree(state.root / layout.STAGING)
            raise
        exchange.complete(state.root, disk)
        disk.remove_tree(state.root / layout.STAGING)
    return EditReport(state.root, len(picks), sum(pick.row["length"] for pick in picks))


def _keep(state: DatasetState, episodes: Sequence[int], target: Path, name: str) -> EditReport:
    check_episodes(state, episodes)
    edit = {"edit": name, "of": state.root.name, "episodes": list(episodes)}
    identity = _edited(state, edit)
    picks = [Pick(state, state.rows[episode]) for episode in episodes]
    return _write_new(target, picks, edit, identity["recording"] if identity else {})


def _write_new(
    target: Path, picks: Sequence[Pick], edit: Mapping[str, Any], recording: Mapping[str, Any]
) -> EditReport:
    identities = [pick.source.identity for pick in picks]
    identity = None
    if identities and all(one is not None for one in identities):
        # Another program's dataset among them: then the whole was not recorded by this one.
        video = (identities[0] or {}).get("video", {})
        identity = {"format": FORMAT, "recording": {**recording, "edited": dict(edit)}, "video": video}
    disk = Disk()
    for source in {pick.source.root for pick in picks}:
        refuse_inside(target, source)
    lock = build_root(
        target,
        lambda folder: assemble(picks, folder, disk, edit=_timed(edit), identity=identity),
        disk,
        "Remove it",
    )
    lock.release()
    return EditReport(target, len(picks), sum(pick.row["length"] for pick in picks))


def _edited(state: DatasetState, edit: Mapping[str, Any]) -> dict[str, Any] | None:
    """Return an identity that cannot be resumed: the next episode would no longer be the one that the seed says."""
    if state.identity is None:
        return None
    recording = {name: value for name, value in state.identity["recording"].items() if name != "edited"}
    return {**state.identity, "recording": {**recording, "edited": dict(edit)}}


def _common(recordings: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return what all recordings share."""
    return {
        name: value for name, value in recordings[0].items() if all(one.get(name) == value for one in recordings[1:])
    }


def _timed(edit: Mapping[str, Any]) -> dict[str, Any]:
    return {"time": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"), **edit}


def check_episodes(state: DatasetState, episodes: Sequence[int]) -> None:
    """Check that there are such episodes, and that none is named twice.

    Raises:
        DatasetError: there is no such episode.
        ConfigError: one is named twice.
    """
    wrong = sorted({episode for episode in episodes if not 0 <= episode < len(state.rows)})
    if wrong:
        raise DatasetError(f"There is no episode {wrong[0]} in {state.root}; valid: 0 to {len(state.rows) - 1}.")
    if len(set(episodes)) != len(episodes):
        twice = next(episode for episode in episodes if list(episodes).count(episode) > 1)
        raise ConfigError(f"Episode {twice} is named twice.")


@contextlib.contextmanager
def opened(roots: Sequence[Path]) -> Iterator[list[DatasetState]]:
    """Lock datasets and read their state."""
    with contextlib.ExitStack() as stack:
        states = []
        for root in roots:
            if not root.is_dir():
                raise no_dataset(root)
            stack.callback(RootLock(root).release)
            state = load_state(root)
            if not state.rows:
                raise DatasetError(f"{root} is empty: it has no episodes.")
            states.append(state)
        yield states


def edits_of(root: Path | str) -> list[dict[str, Any]]:
    """Return what was done to a dataset after its recording, oldest first."""
    path = Path(root) / EDITS
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()] if path.exists() else []
