"""Copy a dataset from the Hub or from below a URL; from the Hub, also the files of some episodes only.

Everything goes into a folder beside the target first, is checked there, and becomes the dataset by a rename. What an
interrupted download from the Hub leaves is in that folder, and the next attempt resumes it.
"""

import shutil
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

from bhd_lerobot.datasets.format.state import load_state
from bhd_lerobot.datasets.remote.listing import (
    MANIFEST,
    SUBSET,
    Remote,
    RemoteFile,
    is_recorded,
    listed,
    matching,
    megabytes,
    parse_info,
    refuse_overlap,
    total,
)
from bhd_lerobot.datasets.remote.staging import Staging
from bhd_lerobot.datasets.remote.subset import files_of, subset_episodes, subset_note
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.datasets.storage.atomic import clean, complete_interrupted, has_unfinished_episodes, is_free
from bhd_lerobot.datasets.storage.disk import RootLock, write_errors
from bhd_lerobot.datasets.storage.places import wrong_path
from bhd_lerobot.errors import BhdError, ConfigError, DatasetError, DatasetExistsError, TransferError, quoted

type Select = Callable[[Path], Sequence[int]]
"""Chooses episodes, given a folder that holds the metadata of the dataset."""

_SPARE_BYTES = 1 << 20


@dataclass(frozen=True)
class PullReport:
    """What a pull did: files that were fetched, and those that were there already (`kept`).

    `episodes` are those that were chosen, now or before, None if none were; `is_whole` says whether all files are there
    nevertheless. `problem` reports why the dataset is not valid, as it is not where it came from either.
    """

    root: Path
    episodes: list[int] | None
    is_whole: bool
    total_episodes: int
    fetched: list[str]
    fetched_bytes: int
    kept: int
    problem: str = ""


def pull(remote: Remote, root: Path | str, *, select: Select | None = None, replace: bool = False) -> PullReport:
    """Make the dataset on this machine the same as a remote one."""
    root = Path(root).expanduser().resolve()
    refuse_overlap(root, remote)
    if select is not None and not remote.has_checksums:
        raise ConfigError(
            f"{remote.name} is a URL, from which only whole datasets can be pulled. Pull all of it, then run bhd-data "
            "filter."
        )
    with write_errors("pull the dataset", root, "The dataset itself was not changed."):
        complete_interrupted(root)
        there = _files(remote)
        staging = Staging(root)
        locks = [RootLock(staging.folder, root)]
        is_useful = False  # what is in the staging folder, for the next attempt
        try:
            if root.is_dir():
                locks.append(RootLock(root))
                clean(root)
            return _Pull(remote, root, there, staging).run(select, replace)
        except BhdError as error:
            is_useful = isinstance(error, TransferError) or not staging.is_new
            raise
        except BaseException:
            is_useful = True
            raise
        finally:
            if not (is_useful and remote.has_checksums):
                staging.drop()
            for lock in locks:
                lock.release()


class _Pull:
    def __init__(self, remote: Remote, root: Path, there: dict[str, RemoteFile], staging: Staging) -> None:
        self._remote, self._root, self._there, self._staging = remote, root, there, staging
        self._fetched: list[str] = []
        self._staged: set[str] = set()  # what is in the staging folder, and checked
        self._same: set[str] = set()  # what the root has already
        self._is_given_up = False  # what lies at the root, for what comes

    def run(self, select: Select | None, replace: bool) -> PullReport:
        there, name = self._there, self._remote.name
        if self._remote.has_checksums:
            self._compare(replace)
        else:
            self._staging.clear(set())
        self._get([layout.INFO])  # whether it is a dataset at all is known before everything is fetched
        info = parse_info((self._staging.folder / layout.INFO).read_bytes(), name)
        if not self._remote.has_checksums:
            self._get(there)
            if self._root.exists():
                there |= {path: RemoteFile.of(self._staging.folder / path) for path in there}
            self._compare(replace)
        episodes, wanted = None, set(there)
        if select is not None:
            wanted = {path for path in there if not is_recorded(path) or path.startswith("meta/")} | self._same
            self._get(wanted)
            episodes, files = self._wanted(select)
            wanted |= files
        self._get(wanted)
        is_whole = all(path in wanted for path in there if is_recorded(path))
        note = None if episodes is None or is_whole else subset_note(name, episodes)
        before = (self._root / SUBSET).read_bytes() if (self._root / SUBSET).exists() else None
        if not wanted <= self._same or note != before:
            self._staging.publish(wanted, note)
        return PullReport(
            root=self._root,
            episodes=episodes,
            is_whole=is_whole,
            total_episodes=info["total_episodes"],
            fetched=sorted(self._fetched),
            fetched_bytes=total(there[path] for path in self._fetched),
            kept=len(wanted) - len(self._fetched),
            problem=_problem(self._root) if is_whole else "",
        )

    def _compare(self, replace: bool) -> None:
        """Find out what need not be fetched because `root` has it; refuse a root that holds something else."""
        root = self._root
        if not root.exists():
            return
        if not root.is_dir():
            raise DatasetExistsError(f"{root} is a file. Choose another folder with --root.")
        if has_unfinished_episodes(root):
            raise DatasetExistsError(
                f"{root} is a recording that was interrupted. Run bhd-data repair {quoted(root)}, or choose another "
                "--root."
            )
        if not is_free(root) and not (root / layout.INFO).is_file():
            raise DatasetExistsError(f"{root} exists and is no dataset. Choose another folder with --root.")
        present = {path: root / path for path in self._there if (root / path).is_file()}
        self._same = matching(present, self._there)
        changed = (present.keys() - self._same) | (layout.recorded_files(root) - self._there.keys())
        if changed and not replace:
            raise DatasetExistsError(
                f"{root} holds another dataset, or was changed since it was pulled: {listed(changed)}. Choose another "
                "folder with --root, or replace it with --replace."
            )
        self._is_given_up = bool(changed)

    def _get(self, paths: Collection[str]) -> None:
        """Bring files into the staging folder: from the root, from an earlier attempt, or from the remote place."""
        folder, new = self._staging.folder, set(paths) - self._staged
        for path in new & self._same:
            self._staging.link(path)
        others = new - self._same
        missing = others - matching({path: folder / path for path in others}, self._there)
        if missing:
            need, free = total(self._there[path] for path in missing), shutil.disk_usage(folder).free
            if need + _SPARE_BYTES > free:
                raise TransferError(
                    f"Could not download {self._remote.name}: {megabytes(need)} are missing, and the disk of {folder} "
                    f"has {megabytes(free)} free. Free some space, or name another --root."
                )
            self._remote.fetch(sorted(missing), folder)
            if wrong := missing - matching({path: folder / path for path in missing}, self._there):
                for path in wrong:
                    (folder / path).unlink(missing_ok=True)
                raise TransferError(
                    f"Could not download {self._remote.name}: {listed(wrong)} differs from what is listed. It was "
                    "changed meanwhile, or lost or damaged on the way."
                )
            self._fetched += missing
        self._staged |= new

    def _wanted(self, select: Select) -> tuple[list[int], set[str]]:
        """Return the chosen episodes, with those that were chosen before, and the files that hold them."""
        staging, name = self._staging.folder, self._remote.name
        try:
            chosen = {int(index) for index in select(staging)}
            files_of(staging, sorted(chosen))  # refuses those that do not exist
        except DatasetError as error:
            raise type(error)(str(error).replace(str(staging), name)) from error
        if not self._is_given_up:  # else the numbers may be those of others
            chosen |= set(subset_episodes(self._root))
        files = files_of(staging, sorted(chosen))
        if lost := files - self._there.keys():
            raise DatasetError(f"{name} is incomplete: {listed(lost)} are missing there.")
        return sorted(chosen), files


def _files(remote: Remote) -> dict[str, RemoteFile]:
    """Return the files of a remote dataset that a copy is to have."""
    there, name = remote.files(), remote.name
    if layout.INFO not in there:
        raise TransferError(
            f"There is no LeRobot dataset at {name}: it has no {layout.INFO}. If it is being uploaded at this moment, "
            "wait until that ends; otherwise check the name and the revision."
        )
    for path in there:
        if wrong := wrong_path(path):
            raise TransferError(f"{name} has a file that cannot be fetched: {wrong}.")
    return {path: file for path, file in there.items() if path[0] != "." and path not in (SUBSET, MANIFEST)}


def _problem(root: Path) -> str:
    try:
        load_state(root)
    except DatasetError as error:
        return str(error)
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        return f"its metadata contradict themselves ({error!r})"
    return ""
