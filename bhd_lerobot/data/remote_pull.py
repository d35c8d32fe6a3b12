"""Copy a dataset from the Hub or from below a URL: all of it, or the files of some episodes.

Everything goes into a folder beside the target first, is compared with its checksums there, and becomes the dataset by
a rename. What an interruption leaves is in that folder, and the next attempt goes on with it.
"""

import contextlib
import json
import os
import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from bhd_lerobot.data import layout
from bhd_lerobot.data.assemble import EDITS
from bhd_lerobot.data.disk import RootLock, to_json, write_errors
from bhd_lerobot.data.remote import (
    SUBSET,
    Remote,
    RemoteFile,
    in_order,
    is_recorded,
    is_whole,
    listed,
    megabytes,
    refuse_overlap,
    total,
)
from bhd_lerobot.data.remote_pool import run_all
from bhd_lerobot.data.remote_subset import Subset, files_of, read_subset
from bhd_lerobot.data.state import load_state
from bhd_lerobot.errors import ConfigError, DatasetError, DatasetExistsError, TransferError

type Select = Callable[[Path], Sequence[int]]
"""Chooses episodes, given a folder that holds the metadata of the dataset."""

_HASHERS = 4
_SPARE_BYTES = 1 << 20


@dataclass(frozen=True)
class PullReport:
    """What a pull did.

    Attributes:
        root: the dataset on this machine.
        episodes: the episodes that were chosen, now and before, by number; None if none were.
        is_whole: whether it holds all files.
        total_episodes: episodes of the whole dataset.
        fetched: files that were fetched.
        fetched_bytes: their bytes.
        kept: files that were there already.
        problem: why the dataset is not sound, as it is not where it came from either; empty if it is.
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
    """Make the dataset on this machine the same as a remote one.

    Of a dataset that is there already, files that are the same are not fetched again.

    Args:
        remote: where from.
        root: where to.
        select: chooses the episodes whose files are wanted; None wants all.
        replace: put the remote dataset in the place of another one, or of a changed one; files that belong to no
            dataset stay.

    Raises:
        ConfigError: both are the same folder.
        DatasetExistsError: there is another dataset at `root`, or a changed one, and `replace` is false.
        DatasetError: the remote dataset has another format, or none of the wanted episodes.
        DatasetLockedError: `root` is being recorded, repaired or pulled by another process.
        DatasetWriteError: this disk refuses the files.
        TransferError: not all of it came; what did is kept, and the next attempt goes on with it.
    """
    root = Path(root).expanduser()
    root = root.parent.resolve() / root.name if not root.is_symlink() else root.resolve()
    refuse_overlap(root, remote)
    with write_errors("pull the dataset", root, "What arrived is kept beside it; the dataset itself was not touched."):
        return _Pull(remote, root, replace).run(select)


_MARKER = ".bhd-pull"
"""In folders beside the target that this program made, and may remove."""


class _Pull:
    def __init__(self, remote: Remote, root: Path, replace: bool) -> None:
        self._remote, self._root, self._replace = remote, root, replace
        self._staging = root.with_name(f".{root.name}.pull")
        self._old = root.with_name(f".{root.name}.old")
        self._fetched: list[str] = []

    def _refuse_others(self) -> None:
        for folder in (self._staging, self._old):
            is_empty = folder.is_dir() and not any(folder.iterdir())
            if folder.exists() and not is_empty and not (folder / _MARKER).exists():
                raise DatasetError(
                    f"{folder} is in the way: bhd-data pull needs this name for a while, and did not make what is "
                    "there. Move it, or choose another --root."
                )

    def run(self, select: Select | None) -> PullReport:
        there = self._files()
        if os.path.ismount(self._root):
            raise DatasetError(f"{self._root} is a mount point, which cannot be exchanged. Name a folder in it.")
        self._refuse_others()
        if self._old.is_dir() and not self._root.exists():
            self._old.rename(self._root)  # a kill between the two renames
            (self._root / _MARKER).unlink(missing_ok=True)
        is_new = not self._staging.exists()
        self._staging.mkdir(parents=True, exist_ok=True)
        (self._staging / _MARKER).touch()
        locks = [RootLock(self._staging, self._root)]
        try:
            if self._root.is_dir():
                locks.append(RootLock(self._root))
            same = self._same(there)
            if layout.INFO not in same:
                self._refuse_other_format()
            meta = [path for path in there if not is_recorded(path) or path.startswith("meta/")]
            subset = None
            if select is not None:
                self._get(meta, there, same)
                subset = self._wanted(select, there)
            wanted = {path for path in there if subset is None or path in subset.files or path in meta} | same
            self._get(sorted(wanted), there, same)
            whole = all(path in wanted for path in there if is_recorded(path))
            if self._fetched or not self._is_complete(wanted, same, whole):
                self._show(wanted, same, None if whole else subset)
            else:
                shutil.rmtree(self._staging)
            info = json.loads((self._root / layout.INFO).read_bytes())
            return PullReport(
                root=self._root,
                episodes=None if subset is None else subset.episodes,
                is_whole=whole,
                total_episodes=info["total_episodes"],
                fetched=in_order(self._fetched),
                fetched_bytes=total(there[path] for path in self._fetched),
                kept=len(wanted) - len(self._fetched),
                problem=_problem(self._root) if whole else "",
            )
        except (ConfigError, DatasetError):
            if is_new:  # refused: there is nothing to go on with
                shutil.rmtree(self._staging, ignore_errors=True)
            raise
        finally:
            for lock in locks:
                lock.release()
            with contextlib.suppress(OSError):
                self._staging.rmdir()  # if nothing came

    def _files(self) -> dict[str, RemoteFile]:
        there = self._remote.files()
        name = self._remote.name
        if layout.INFO not in there:
            raise TransferError(
                f"There is no LeRobot dataset at {name}: it has no {layout.INFO}. If it is being uploaded at this "
                "moment, wait until that ends; otherwise check the name and the revision."
            )
        for path in there:
            if path.startswith("/") or ".." in PurePosixPath(path).parts:
                raise TransferError(f"{name} has a file {path!r}, which would lie outside of the dataset.")
        hidden = {path for path in there if path.startswith(".") or path == SUBSET}
        return {path: file for path, file in there.items() if path not in hidden}

    def _refuse_other_format(self) -> None:
        """Say so before everything is fetched."""
        name = self._remote.name
        try:
            version = json.loads(self._remote.read(layout.INFO) or b"")["codebase_version"]
        except (ValueError, KeyError, TypeError) as error:
            raise DatasetError(
                f"{name} is no LeRobot dataset: its {layout.INFO} cannot be read ({error!r})."
            ) from error
        if not str(version).startswith("v3."):
            raise DatasetError(
                f"{name} has dataset format {version}; this program reads v3.x. Convert it with LeRobot."
            )

    def _same(self, there: Mapping[str, RemoteFile]) -> set[str]:
        """Return what need not be fetched because `root` has it; refuse a root that holds something else."""
        root = self._root
        if not root.exists():
            return set()
        if not root.is_dir():
            raise DatasetExistsError(f"{root} is a file. Choose another folder with --root.")
        if (root / layout.STAGING).exists():
            raise DatasetExistsError(
                f"{root} is a recording that was interrupted. Run bhd-data repair {root}, or choose another --root."
            )
        if any(root.iterdir()) and not (root / layout.INFO).is_file():
            raise DatasetExistsError(f"{root} exists and is no dataset. Choose another folder with --root.")
        same = _compare(root, [path for path in there if (root / path).is_file()], there)
        changed = {path for path in there if (root / path).is_file() and path not in same}
        changed |= layout.recorded_files(root) - there.keys()
        if changed and not self._replace:
            raise DatasetExistsError(
                f"{root} holds another dataset, or was changed since it was pulled: {listed(changed)}. Choose another "
                "folder with --root, or give what is there up with --replace."
            )
        return same

    def _get(self, paths: Sequence[str], there: Mapping[str, RemoteFile], same: set[str]) -> None:
        """Bring files into the staging folder, from the root or from afar, and check that they are whole."""
        staging = self._staging
        for path in (one for one in paths if one in same and not (staging / one).exists()):
            _link(self._root / path, staging / path)
        staged = [path for path in paths if (staging / path).is_file() and path not in same]
        arrived = _compare(staging, staged, there) | same | set(self._fetched)
        for path in staged:
            if path not in arrived:
                (staging / path).unlink()  # of another version
        missing = [path for path in paths if path not in arrived]
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

    def _wanted(self, select: Select, there: Mapping[str, RemoteFile]) -> Subset:
        try:
            chosen = {int(one) for one in select(self._staging)}
            files_of(self._staging, sorted(chosen))
        except DatasetError as error:
            raise type(error)(str(error).replace(str(self._staging), self._remote.name)) from error
        episodes = set(chosen)
        if (self._root / SUBSET).is_file():
            episodes |= set(read_subset(self._root))
        files = files_of(self._staging, sorted(episodes))
        lost = files - there.keys()
        if lost:
            raise DatasetError(f"{self._remote.name} is not whole: {listed(lost)} are missing there.")
        return Subset(sorted(episodes), files)

    def _is_complete(self, wanted: set[str], same: set[str], whole: bool) -> bool:
        return wanted <= same and whole != (self._root / SUBSET).exists()

    def _show(self, wanted: set[str], same: set[str], subset: Subset | None) -> None:
        """Let the staging folder become the dataset."""
        root, staging = self._root, self._staging
        shutil.rmtree(staging / ".cache", ignore_errors=True)
        _remove_others(staging, wanted)
        if subset is not None:
            about = {"source": self._remote.name, "episodes": subset.episodes}
            (staging / SUBSET).write_bytes(to_json(about))
        if root.is_dir() and any(root.iterdir()):
            for path in _foreign(root, wanted):
                _link(root / path, staging / path)
            shutil.rmtree(self._old, ignore_errors=True)
            (root / _MARKER).touch()
            root.rename(self._old)
            staging.rename(root)
            shutil.rmtree(self._old)
        else:
            staging.rename(root)
        (root / _MARKER).unlink(missing_ok=True)


def _problem(root: Path) -> str:
    """Return why a dataset is not sound; nothing if it is."""
    try:
        load_state(root)
    except DatasetError as error:
        return str(error)
    return ""


def _compare(folder: Path, paths: Sequence[str], there: Mapping[str, RemoteFile]) -> set[str]:
    """Return which files are the listed ones."""
    found: set[str] = set()

    def compare(path: str) -> None:
        if is_whole(folder / path, there[path]):
            found.add(path)

    run_all(compare, paths, _HASHERS)
    return found


def _link(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    if source.is_symlink():
        target.symlink_to(os.readlink(source))
        return
    if source.is_dir():
        target.mkdir(exist_ok=True)
        target.chmod(source.stat().st_mode & 0o7777)
        return
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)


def _foreign(root: Path, wanted: Iterable[str]) -> list[str]:
    """Return what in a folder belongs to no dataset, folders before what is in them: notes, for example, or `.git`."""
    ours = {*wanted, _MARKER, SUBSET, EDITS, layout.INFO, layout.STATS, layout.TASKS, layout.IDENTITY}
    found: list[str] = []
    for place, folders, files in os.walk(root):
        inside = Path(place).relative_to(root)
        folders[:] = [name for name in folders if (inside / name).as_posix() != ".cache/huggingface"]
        # A link to a folder is a thing of its own, and an empty folder may mean something to who made it.
        names = [*files, *(name for name in folders if _is_kept(root / inside / name))]
        found += [(inside / name).as_posix() for name in names]
    return [path for path in found if path not in ours and not is_recorded(path)]


def _is_kept(folder: Path) -> bool:
    return folder.is_symlink() or not any(folder.iterdir())


def _remove_others(folder: Path, wanted: set[str]) -> None:
    """Remove what an attempt for another version left."""
    for path in sorted(folder.rglob("*"), reverse=True):
        if path.is_file() and path.relative_to(folder).as_posix() not in {*wanted, _MARKER}:
            path.unlink()
        elif path.is_dir() and not any(path.iterdir()):
            path.rmdir()
