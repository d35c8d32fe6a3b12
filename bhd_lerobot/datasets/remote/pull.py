"""Copy a dataset from the Hub or from below a URL: all of it, or the files of some episodes.

Everything goes into a folder beside the target first, is compared with its checksums there, and becomes the dataset by
a rename. What an interruption leaves is in that folder, and the next attempt goes on with it.
"""

import shutil
from collections.abc import Callable, Collection, Iterable, Sequence
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
    megabytes,
    parse_info,
    refuse_overlap,
    run_all,
    total,
)
from bhd_lerobot.datasets.remote.staging import Staging
from bhd_lerobot.datasets.remote.subset import files_of, subset_episodes, subset_note
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.datasets.storage.atomic import clean, complete_interrupted, has_unfinished_episodes, is_free
from bhd_lerobot.datasets.storage.disk import RootLock, write_errors
from bhd_lerobot.datasets.storage.places import wrong_path
from bhd_lerobot.errors import ConfigError, DatasetError, DatasetExistsError, TransferError, quoted

type Select = Callable[[Path], Sequence[int]]
"""Chooses episodes, given a folder that holds the metadata of the dataset."""

_SPARE_BYTES = 1 << 20


@dataclass(frozen=True)
class PullReport:
    """What a pull did.

    Attributes:
        root: the dataset on this machine.
        episodes: the episodes that were chosen, and those that were there before, by number; None if none were.
        is_whole: whether it holds all files, though only some episodes may have been requested.
        total_episodes: episodes of the whole dataset.
        fetched: files that were fetched.
        fetched_bytes: their bytes.
        kept: files that were there already.
        by_size: how many of these were compared by their size alone, because nothing else is known of them.
        problem: why the dataset is not valid, as it is not where it came from either; empty if it is.
    """

    root: Path
    episodes: list[int] | None
    is_whole: bool
    total_episodes: int
    fetched: list[str]
    fetched_bytes: int
    kept: int
    by_size: int
    problem: str = ""


def pull(
    remote: Remote,
    root: Path | str,
    *,
    select: Select | None = None,
    replace: bool = False,
    verify: bool = False,
) -> PullReport:
    """Make the dataset on this machine the same as a remote one.

    Of a dataset that is there already, files that are the same are not fetched again.

    Args:
        remote: where from.
        root: where to.
        select: chooses the episodes whose files are wanted; None wants all.
        replace: put the remote dataset in the place of another one, or of a changed one; files that belong to no
            dataset stay.
        verify: read what lies at the remote place also of files that are here already, and compare contents instead of
            what is listed about them.

    Raises:
        ConfigError: both are the same folder.
        DatasetExistsError: there is another dataset at `root`, or a changed one, and `replace` is false.
        DatasetError: the remote dataset has another format, or none of the wanted episodes.
        DatasetLockedError: `root` is being recorded, repaired or pulled by another process.
        DatasetWriteError: this disk refuses the files.
        TransferError: not all of it arrived; what did is kept, and the next attempt goes on with it.
    """
    root = Path(root).expanduser().resolve()
    refuse_overlap(root, remote)
    with write_errors("pull the dataset", root, "What arrived is kept beside it; the dataset itself was not changed."):
        return _Pull(remote, root, replace).run(select, verify)


class _Pull:
    def __init__(self, remote: Remote, root: Path, replace: bool) -> None:
        complete_interrupted(root)
        self._remote, self._root, self._replace = remote, root, replace
        self._there = _files(remote)
        self._staging = Staging(root)
        self._fetched: list[str] = []
        self._by_size: set[str] = set()
        self._is_given_up = False  # what lies at the root, for what comes

    def run(self, select: Select | None, verify: bool) -> PullReport:
        locks = [RootLock(self._staging.folder, self._root)]
        try:
            self._staging.recover()
            if self._root.is_dir():
                locks.append(RootLock(self._root))
                clean(self._root)
            if verify:
                self._there |= self._verified()
            return self._run(select)
        except (ConfigError, DatasetError):
            if self._staging.is_new:  # refused: there is nothing to go on with
                self._staging.drop()
            raise
        finally:
            for lock in locks:
                lock.release()

    def _run(self, select: Select | None) -> PullReport:
        there, staging, name = self._there, self._staging.folder, self._remote.name
        same = self._same()
        wanted = {path for path in there if not is_recorded(path) or path.startswith("meta/")} | same
        for paths in ([layout.INFO], wanted):  # whether it is a dataset at all is known before everything is fetched
            self._get(paths, same)
            info = parse_info((staging / layout.INFO).read_bytes(), name)
        episodes = None
        if select is None:
            wanted = set(there)
        else:
            episodes, files = self._wanted(select)
            wanted |= files
        self._get(wanted, same)
        is_whole = all(path in wanted for path in there if is_recorded(path))
        note = None if episodes is None or is_whole else subset_note(name, episodes)
        before = (self._root / SUBSET).read_bytes() if (self._root / SUBSET).exists() else None
        if wanted <= same and note == before:
            self._staging.drop()
        else:
            self._staging.publish(wanted, note)
        return PullReport(
            root=self._root,
            episodes=episodes,
            is_whole=is_whole,
            total_episodes=info["total_episodes"],
            fetched=sorted(self._fetched),
            fetched_bytes=total(there[path] for path in self._fetched),
            kept=len(wanted) - len(self._fetched),
            by_size=len(self._by_size & wanted - set(self._fetched)),
            problem=_problem(self._root) if is_whole else "",
        )

    def _verified(self) -> dict[str, RemoteFile]:
        """Read the remote files that would not be fetched; return the checksums of those that had none.

        Raises:
            TransferError: a file is not what was put there.
        """
        there, folders = self._there, (self._root, self._staging.folder)
        sizes = [
            {path: (folder / path).stat().st_size for path in there if (folder / path).is_file()} for folder in folders
        ]
        found = self._remote.verified(
            [path for path in there if any(size.get(path) == there[path].size for size in sizes)]
        )
        if damaged := [path for path in found if there[path].digest not in (None, found[path].digest)]:
            raise TransferError(
                f"{self._remote.name} is damaged, or was changed by another program: {listed(damaged)} there are not "
                "what was sent. Push the dataset again with --verify from where it is complete."
            )
        return found

    def _same(self) -> set[str]:
        """Return what need not be fetched because `root` has it; refuse a root that holds something else."""
        root = self._root
        if not root.exists():
            return set()
        if not root.is_dir():
            raise DatasetExistsError(f"{root} is a file. Choose another folder with --root.")
        if has_unfinished_episodes(root):
            raise DatasetExistsError(
                f"{root} is a recording that was interrupted. Run bhd-data repair {quoted(root)}, or choose another "
                "--root."
            )
        if not is_free(root) and not (root / layout.INFO).is_file():
            raise DatasetExistsError(f"{root} exists and is no dataset. Choose another folder with --root.")
        present = [path for path in self._there if (root / path).is_file()]
        same = self._compare(root, present)
        changed = (set(present) - same) | (layout.recorded_files(root) - self._there.keys())
        if changed and not self._replace:
            raise DatasetExistsError(
                f"{root} holds another dataset, or was changed since it was pulled: {listed(changed)}. Choose another "
                "folder with --root, or give what is there up with --replace."
            )
        self._is_given_up = bool(changed)
        return same

    def _get(self, paths: Collection[str], same: set[str]) -> None:
        """Bring files into the staging folder, from the root or from the remote place, and check them."""
        staging, there = self._staging.folder, self._there
        for path in same.intersection(paths):
            self._staging.link(path)
        staged = [path for path in paths if path not in same and (staging / path).is_file()]
        arrived = self._compare(staging, [path for path in staged if path not in self._fetched])
        arrived |= same | set(self._fetched)
        for path in staged:
            if path not in arrived:
                (staging / path).unlink()  # of another version
        missing = sorted(set(paths) - arrived)
        if not missing:
            return
        need, free = total(there[path] for path in missing), shutil.disk_usage(staging).free
        if need + _SPARE_BYTES > free:
            raise TransferError(
                f"Could not download {self._remote.name}: {megabytes(need)} are missing, and the disk of {staging} has "
                f"{megabytes(free)} free. Free some space, or name another --root."
            )
        self._remote.fetch(missing, staging)
        self._fetched += missing

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

    def _compare(self, folder: Path, paths: Iterable[str]) -> set[str]:
        """Return which files in a folder are the listed ones."""
        found: set[str] = set()

        def compare(path: str) -> None:
            if self._there[path].matches(folder / path):
                found.add(path)

        run_all(compare, list(paths))
        self._by_size |= {path for path in found if self._there[path].digest is None}
        return found


def _files(remote: Remote) -> dict[str, RemoteFile]:
    """Return the files of a remote dataset that a copy is to have.

    Raises:
        TransferError: there is no dataset, or a path that would lie outside of a copy.
    """
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
    """Return why a dataset is not valid; nothing if it is."""
    try:
        load_state(root)
    except DatasetError as error:
        return str(error)
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        return f"its metadata contradict themselves ({error!r})"
    return ""
