"""Other datasets out of datasets: merge several, keep some episodes, delete some, split one."""

import contextlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pyarrow as pa

from bhd_lerobot.datasets.assembly.assemble import EDITS, assemble, check_alike, edit_lines, logged_now
from bhd_lerobot.datasets.assembly.creation import build_root
from bhd_lerobot.datasets.assembly.picks import Pick
from bhd_lerobot.datasets.edit.overlap import each_once
from bhd_lerobot.datasets.format.identity import FORMAT, conflicts
from bhd_lerobot.datasets.format.state import DatasetState, corrupt, load_state, no_dataset, read_json
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.datasets.storage.atomic import (
    Workspace,
    building,
    clean,
    complete_interrupted,
    is_free,
    real,
    refuse_inside,
    remove_abandoned,
    uninterrupted,
)
from bhd_lerobot.datasets.storage.disk import Disk, RootLock, to_json, write_errors
from bhd_lerobot.errors import (
    ConfigError,
    DatasetError,
    DatasetExistsError,
    DatasetMismatchError,
    brief,
    counted,
    quoted,
)
from bhd_lerobot.options.units import other_units


@dataclass(frozen=True)
class EditReport:
    """What came out of an edit.

    Attributes:
        is_repeated: whether this edit had been completed before, by a process that was killed before it reported it;
            nothing was changed now.
        left_out: episodes of each source that one before it has, too.
    """

    root: Path
    episodes: int
    frames: int
    is_repeated: bool = False
    left_out: Mapping[Path, Sequence[int]] = field(default_factory=dict)

    def __str__(self) -> str:
        note = "; the same edit was interrupted before, after it had been completed: nothing was changed now"
        size = f"{counted(self.episodes, 'episode')}, {counted(self.frames, 'frame')}"
        lines = [f"{self.root}: {size}{note if self.is_repeated else ''}"]
        for root, episodes in self.left_out.items():
            what = f"{counted(len(episodes), 'episode')} of {root}, which a dataset before it has, too"
            lines.append(f"  left out: {what}: {brief(episodes)}")
        return "\n".join(lines)


type OnDone = Callable[[EditReport], object]
"""Called with the report when an edit is in force. Until it returns, the same edit is recognised as repeated."""


def merge(roots: Sequence[Path | str], target: Path | str) -> EditReport:
    """Make one dataset of all episodes of several, in their order; what several of them have is in it once."""
    paths = [Path(root) for root in roots]
    if len(paths) < 2:
        raise ConfigError(f"Merging takes at least two datasets; got {len(paths)}.")
    resolved = [path.resolve() for path in paths]
    for path in resolved:
        if resolved.count(path) > 1:
            raise ConfigError(f"{path} is given more than once; its episodes would be in the new dataset twice.")
    with opened(paths) as states:
        check_alike(states)
        picks, left_out = each_once(states)
        sizes = [
            {"root": state.root.name, "episodes": len(state.rows) - len(left_out.get(state.root, ()))}
            for state in states
        ]
        recordings = [(state.identity or {}).get("recording", {}) for state in states]
        _check_units(paths, recordings)
        recording = _common(recordings) | ({"differing": names} if (names := _differing(recordings)) else {})
        report = _write_new(Path(target), picks, {"edit": "merge", "sources": sizes}, recording)
        return replace(report, left_out=left_out)


def _check_units(paths: Sequence[Path], recordings: Sequence[Mapping[str, Any]]) -> None:
    """Check that the numbers of all datasets mean the same to the robot."""
    for path, recording in zip(paths, recordings, strict=True):
        for name, first, here in other_units(recordings[0].get("robot", {}), recording.get("robot", {})):
            raise DatasetMismatchError(
                f"{paths[0]} was recorded with robot.{name} = {first} and {path} with {here}: the same numbers mean "
                "something else in both, and a policy would learn them as one. Convert one of them first."
            )


def keep(root: Path | str, episodes: Sequence[int], target: Path | str) -> EditReport:
    """Copy some episodes of a dataset to a new one; the original is not changed."""
    with opened([Path(root)]) as (state,):
        check_reported(state.root)
        edit, recording = _kept(state, episodes, "keep")
        return _write_new(Path(target), _picks(state, episodes), edit, recording)


def split(root: Path | str, parts: Mapping[str, Sequence[int]], folder: Path | str) -> list[EditReport]:
    """Split a dataset into several new ones; the original is not changed."""
    owner: dict[int, str] = {}
    for name, episodes in parts.items():
        for episode in episodes:
            if owner.setdefault(episode, name) != name:
                raise ConfigError(f"Episode {episode} is assigned to {owner[episode]!r} and to {name!r}.")
    folder = Path(folder)
    remove_abandoned(real(folder))
    with opened([Path(root)]) as (state,):
        check_reported(state.root)
        refuse_inside(folder / "part", state.root)
        for name, episodes in parts.items():
            check_episodes(state, episodes)
            if not episodes:
                raise ConfigError(f"Part {name!r} would have no episode; {root} has {len(state.rows)}.")
        picks = {name: _picks(state, episodes) for name, episodes in parts.items()}
        done = [_report(folder / name, picks[name]) for name in parts]
        if complete_interrupted(folder) and all((folder / name).exists() for name in parts):
            return [replace(report, is_repeated=True) for report in done]

        def refuse() -> None:
            for name in parts:
                if not is_free(folder / name):
                    raise DatasetExistsError(f"{folder / name} exists already. Remove it, or choose another folder.")
            if folder.exists() and not folder.is_dir():
                raise DatasetExistsError(f"{folder} is a file. Choose another folder.")

        disk = Disk()
        with write_errors("split the dataset", folder, "No part was written."), building(folder, disk, refuse) as space:
            disk.make_folder(space.folder)
            for name, episodes in parts.items():
                _fill(space.folder / name, disk, picks[name], *_kept(state, episodes, "split"))
        return done


def delete(root: Path | str, episodes: Sequence[int], on_done: OnDone = lambda _: None) -> EditReport:
    """Remove episodes from a dataset, in place; the others are renumbered.

    A kill at any moment leaves either the old dataset or the new one. If the new one is in place and `on_done` has not
    returned, the same call only reports that, and another one with numbers of episodes is refused once.
    """
    edit = {"edit": "delete", "episodes": sorted(set(episodes))}

    def change(state: DatasetState) -> Change:
        check_episodes(state, episodes)
        gone = set(episodes)
        picks = [Pick(state, row) for row in state.rows if row["episode_index"] not in gone]
        return Change(picks, edit, _edited(state, edit))

    return rewrite(Path(root), edit, change, on_done)


@dataclass(frozen=True)
class Change:
    """Other content for a dataset.

    Attributes:
        edit: the entry in ``meta/edits.jsonl``; the time is added.
        types: Arrow types of new metadata columns, by name without prefix.
    """

    picks: Sequence[Pick]
    edit: Mapping[str, Any]
    identity: Mapping[str, Any] | None
    types: Mapping[str, pa.DataType] = field(default_factory=dict)


def rewrite(
    root: Path, request: Mapping[str, Any], change: Callable[[DatasetState], Change], on_done: OnDone
) -> EditReport:
    """Put other content into a dataset."""
    with contextlib.ExitStack() as stack:
        lock = _lock(root)
        stack.callback(lock.release)
        if (report := _repeated(root, request)) is None:
            check_reported(root)
            state = _state_of(root)
            new, disk = change(state), Disk()
            edit = logged_now(new.edit)
            with (
                write_errors(f"{edit['edit']} episodes", root, "The dataset is as it was."),
                Workspace(root, disk, lock) as space,
            ):
                assemble(
                    new.picks, space.folder, disk, types=new.types, in_place=True, edit=edit, identity=new.identity
                )
                unreported = {"request": request, "time": edit["time"]}
                disk.write(space.folder / layout.UNREPORTED, to_json(unreported))
                space.publish(f"the edit of {root} had been completed")
            disk.try_remove_tree(root / layout.STAGING)
            report = _report(root, new.picks)
        with uninterrupted():  # or a repeated edit would be reported twice
            on_done(report)
            (root / layout.UNREPORTED).unlink(missing_ok=True)
    return report


def _repeated(root: Path, request: Mapping[str, Any]) -> EditReport | None:
    """Return the report of the last edit, if it was not reported and is the requested one."""
    if (last := _unreported(root)) is None or last.get("request") != json.loads(json.dumps(request)):
        return None
    state = _state_of(root)
    return EditReport(root, state.num_episodes, state.num_frames, is_repeated=True)


def _unreported(root: Path) -> dict[str, Any] | None:
    """Return the last edit of the dataset, if it was not reported."""
    path = root / layout.UNREPORTED
    if not path.is_file():
        return None
    last, edits = read_json(path), edits_of(root)
    # Another dataset may have been put into this place since.
    return last if edits and edits[-1].get("time") == last.get("time") else None


def check_reported(root: Path) -> None:
    """Refuse, once, numbers of episodes after an edit that was not reported."""
    if (last := _unreported(root)) is None:
        return
    request = ", ".join(f"{name} {value}" for name, value in dict(last.get("request") or {}).items())
    (root / layout.UNREPORTED).unlink(missing_ok=True)
    raise DatasetError(
        f"{root} has changed: an edit ({request}) that was interrupted at {last.get('time')} had been completed, so "
        f"episodes may have other numbers now. Check `bhd-data info {quoted(root)}`, then repeat this command. Nothing "
        "was changed now."
    )


def _picks(state: DatasetState, episodes: Sequence[int]) -> list[Pick]:
    return [Pick(state, state.rows[episode]) for episode in episodes]


def _kept(state: DatasetState, episodes: Sequence[int], name: str) -> tuple[dict[str, Any], Mapping[str, Any]]:
    """Return the log entry and the recording of a new dataset of some episodes."""
    check_episodes(state, episodes)
    edit = {"edit": name, "of": state.root.name, "episodes": list(episodes)}
    identity = _edited(state, edit)
    return edit, identity["recording"] if identity else {}


def _write_new(
    target: Path, picks: Sequence[Pick], edit: Mapping[str, Any], recording: Mapping[str, Any]
) -> EditReport:
    disk = Disk()
    for source in {pick.source.root for pick in picks}:
        refuse_inside(target, source)
    lock = build_root(target, lambda folder: _fill(folder, disk, picks, edit, recording), disk, "Remove it")
    lock.release()
    return _report(target, picks)


def _fill(
    folder: Path, disk: Disk, picks: Sequence[Pick], edit: Mapping[str, Any], recording: Mapping[str, Any]
) -> None:
    identities = [pick.source.identity for pick in picks]
    identity = None
    if identities and all(identity is not None for identity in identities):
        # Another program's dataset among them: then the whole was not recorded by this one.
        video = (identities[0] or {}).get("video", {})
        identity = {"format": FORMAT, "recording": {**recording, "edited": dict(edit)}, "video": video}
    assemble(picks, folder, disk, edit=logged_now(edit), identity=identity)


def _report(root: Path, picks: Sequence[Pick]) -> EditReport:
    return EditReport(root, len(picks), sum(pick.row["length"] for pick in picks))


def _edited(state: DatasetState, edit: Mapping[str, Any]) -> dict[str, Any] | None:
    """Return an identity that cannot be resumed: the next episode would not be the one of its seed."""
    if state.identity is None:
        return None
    recording = {name: value for name, value in state.identity["recording"].items() if name != "edited"}
    return {**state.identity, "recording": {**recording, "edited": dict(edit)}}


def _common(recordings: Sequence[Mapping[str, Any]], *, of_one_type: bool = False) -> dict[str, Any]:
    """Return what all recordings share; of a robot or a task of one type, the options that are the same."""
    shared: dict[str, Any] = {}
    for name, value in recordings[0].items():
        others = [recording.get(name) for recording in recordings[1:]]
        if all(other == value for other in others):
            shared[name] = value
        elif isinstance(value, dict) and all(isinstance(other, dict) for other in others):
            options = _common([value, *(other for other in others if isinstance(other, dict))], of_one_type=True)
            if of_one_type or "type" in options:
                shared[name] = options
    return shared


def _differing(recordings: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the options of the robot that recordings, or those that they were merged of, state differently."""
    first, *others = [recording.get("robot", {}) for recording in recordings]
    names = {name for other in others for name, *_ in conflicts("robot", first, other)}
    return sorted(names.union(*(recording.get("differing", ()) for recording in recordings)))


def check_episodes(state: DatasetState, episodes: Sequence[int]) -> None:
    """Check that there are such episodes, and that none is named twice."""
    wrong = sorted({episode for episode in episodes if not 0 <= episode < len(state.rows)})
    if wrong:
        raise DatasetError(f"There is no episode {wrong[0]} in {state.root}; valid: 0 to {len(state.rows) - 1}.")
    if len(set(episodes)) != len(episodes):
        twice = next(episode for episode in episodes if list(episodes).count(episode) > 1)
        raise ConfigError(f"Episode {twice} is named twice.")


@contextlib.contextmanager
def opened(roots: Sequence[Path]) -> Iterator[list[DatasetState]]:
    """Read the state of datasets, which others may read, too, and nobody writes meanwhile."""
    with contextlib.ExitStack() as stack:
        for root in roots:
            stack.callback(_lock(root, is_shared=True).release)
        yield [_state_of(root) for root in roots]


def _lock(root: Path, *, is_shared: bool = False) -> RootLock:
    if not root.is_dir():
        raise no_dataset(root)
    complete_interrupted(root)
    remove_abandoned(real(root))
    lock = RootLock(root, is_shared=is_shared)
    if not is_shared:
        clean(root)
    return lock


def _state_of(root: Path) -> DatasetState:
    state = load_state(root)
    if not state.rows:
        raise DatasetError(f"{root} is empty: it has no episodes.")
    return state


def edits_of(root: Path | str) -> list[dict[str, Any]]:
    """Return what was done to a dataset after its recording, oldest first."""
    try:
        return [json.loads(line) for line in edit_lines(Path(root))]
    except ValueError as error:
        raise corrupt(Path(root) / EDITS, error) from error
