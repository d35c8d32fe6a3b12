"""Copy a dataset from the Hub or from below a URL: all of it, or the files of some episodes.

Everything goes into a folder beside the target first, is compared with its checksums there, and becomes the dataset by
a rename. What an interruption leaves is in that folder, and the next attempt goes on with it.
"""

import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bhd_lerobot.datasets.format.state import load_state
from bhd_lerobot.datasets.remote.listing import (
    MANIFEST,
    SUBSET,
    Remote,
    RemoteFile,
    in_order,
    is_recorded,
    is_whole,
    listed,
    megabytes,
    parse_info,
    refuse_overlap,
    total,
)
from bhd_lerobot.datasets.remote.pool import run_all
from bhd_lerobot.datasets.remote.staging import Staging
from bhd_lerobot.datasets.remote.subset import Subset, SubsetNote, files_of, read_subset, subset_note
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.datasets.storage.atomic import clean, complete_interrupted, has_unfinished_episodes, is_free
from bhd_lerobot.datasets.storage.disk import RootLock, write_errors
from bhd_lerobot.datasets.storage.places import wrong_path
from bhd_lerobot.errors import ConfigError, DatasetError, DatasetExistsError, TransferError, quoted

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
        is_whole: whether it holds all files, though only some episodes may have been asked for.
        is_noted: whether `SUBSET` there says which episodes were asked for.
        total_episodes: episodes of the whole dataset.
        fetched: files that were fetched.
        fetched_bytes: their bytes.
        kept: files that were there already.
        by_size: how many of these were compared by their size alone, because nothing else is known of them.
        problem: why the dataset is not sound, as it is not where it came from either; empty if it is.
    """

    root: Path
    episodes: list[int] | None
    is_whole: bool
    is_noted: bool
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
        ConfigError: both are the same folder, or the place needs no verifying.
        DatasetExistsError: there is another dataset at `root`, or a changed one, and `replace` is false.
        DatasetError: the remote dataset has another format, or none of the wanted episodes.
        DatasetLockedError: `root` is being recorded, repaired or pulled by another process.
        DatasetWriteError: this disk refuses the files.
        TransferError: not all of it came; what did is kept, and the next attempt goes on with it.
    """
    root = Path(root).expanduser().resolve()
    refuse_overlap(root, remote)
    with write_errors("pull the dataset", root, "What arrived is kept beside it; the dataset itself was not touched."):
        return _Pull(remote, root, replace, verify).run(select)


class _Pull:
    def __init__(self, remote: Remote, root: Path, replace: bool, verify: bool) -> None:
        self._remote, self._root, self._replace, self._verify = remote, root, replace, verify
        self._fetched: list[str] = []
        self._by_size: set[str] = set()
        self._is_given_up = False  # what lies at the root, for what comes

    def run(self, select: Select | None) -> PullReport:
        complete_interrupted(self._root)
        there = self._files()
        self._staging = Staging(self._root)
        locks = [RootLock(self._staging.folder, self._root)]
        try:
            self._staging.recover()
            if self._root.is_dir():
                locks.append(RootLock(self._root))
                clean(self._root)
            if self._verify:
                there |= self._verified(there)
            same = self._same(there)
            info = self._info(there, is_same=layout.INFO in same)
            recorded = {path for path in there if is_recorded(path)}
            was_whole = recorded <= same and not (self._root / SUBSET).exists()
            meta = [path for path in there if not is_recorded(path) or path.startswith("meta/")]
            subset = None
            if select is not None:
                self._get(meta, there, same)
                subset = self._wanted(select, there)
            wanted = {path for path in there if subset is None or path in subset.files or path in meta} | same
            self._get(sorted(wanted), there, same)
            # All of a dataset stays all of it, whatever is asked for.
            note = None if subset is None or was_whole else SubsetNote(subset.episodes, recorded <= wanted)
            if self._fetched or not self._is_complete(wanted, same, note):
                self._staging.show(wanted, None if note is None else subset_note(self._remote.name, note))
            else:
                self._staging.drop()
            return PullReport(
                root=self._root,
                episodes=None if subset is None else subset.episodes,
                is_whole=recorded <= wanted,
                is_noted=note is not None,
                total_episodes=info["total_episodes"],
                fetched=in_order(self._fetched),
                fetched_bytes=total(there[path] for path in self._fetched),
                kept=len(wanted) - len(self._fetched),
                by_size=len(self._by_size & wanted - set(self._fetched)),
                problem=_problem(self._root) if recorded <= wanted else "",
            )
        except (ConfigError, DatasetError):
            if self._staging.is_new:  # refused: there is nothing to go on with
                self._staging.drop()
            raise
        finally:
            for lock in locks:
                lock.release()
            self._staging.drop_if_empty()

    def _files(self) -> dict[str, RemoteFile]:
        there = self._remote.files()
        name = self._remote.name
        if layout.INFO not in there:
            raise TransferError(
                f"There is no LeRobot dataset at {name}: it has no {layout.INFO}. If it is being uploaded at this "
                "moment, wait until that ends; otherwise check the name and the revision."
            )
        for path in there:
            if wrong := wrong_path(path):
                raise TransferError(f"{name} has a file that cannot be fetched: {wrong}.")
        hidden = {path for path in there if path.startswith(".") or path in (SUBSET, MANIFEST)}
        return {path: file for path, file in there.items() if path not in hidden}

    def _info(self, there: Mapping[str, RemoteFile], *, is_same: bool) -> dict[str, Any]:
        """Return what is said about the dataset, before everything is fetched."""
        if is_same:
            return parse_info((self._root / layout.INFO).read_bytes(), self._remote.name)
        content = self._remote.read(layout.INFO)
        info = parse_info(content, self._remote.name)
        staged = self._staging.folder / layout.INFO
        staged.parent.mkdir(exist_ok=True)
        staged.unlink(missing_ok=True)  # an attempt before may have linked it to the one of the dataset that is there
        staged.write_bytes(content or b"")
        if is_whole(staged, there[layout.INFO]):
            self._fetched.append(layout.INFO)
        return info

    def _verified(self, there: Mapping[str, RemoteFile]) -> dict[str, RemoteFile]:
        """Read the files afar that would not be fetched; return the checksums of those that had none.

        Raises:
            TransferError: a file is not what was put there.
        """
        folders = (self._root, self._staging.folder)
        sizes = [{path: (one / path).stat().st_size for path in there if (one / path).is_file()} for one in folders]
        found = self._remote.verified(
            [path for path in there if any(one.get(path) == there[path].size for one in sizes)]
        )
        if damaged := [path for path in found if there[path].digest not in (None, found[path].digest)]:
            raise TransferError(
                f"{self._remote.name} is damaged, or was changed by another program: {listed(damaged)} there are not "
                "what was sent. Push the dataset again with --verify from where it is whole."
            )
        return found

    def _same(self, there: Mapping[str, RemoteFile]) -> set[str]:
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
        same = self._compare(root, [path for path in there if (root / path).is_file()], there)
        changed = {path for path in there if (root / path).is_file() and path not in same}
        changed |= layout.recorded_files(root) - there.keys()
        if changed and not self._replace:
            raise DatasetExistsError(
                f"{root} holds another dataset, or was changed since it was pulled: {listed(changed)}. Choose another "
                "folder with --root, or give what is there up with --replace."
            )
        self._is_given_up = bool(changed)
        return same

    def _get(self, paths: Sequence[str], there: Mapping[str, RemoteFile], same: set[str]) -> None:
        """Bring files into the staging folder, from the root or from afar, and check that they are whole."""
        staging = self._staging.folder
        for path in (one for one in paths if one in same):
            self._staging.take(path)
        staged = [path for path in paths if (staging / path).is_file() and path not in same]
        arrived = self._compare(staging, staged, there) | same | set(self._fetched)
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
            chosen = {int(one) for one in select(self._staging.folder)}
            files_of(self._staging.folder, sorted(chosen))
        except DatasetError as error:
            raise type(error)(str(error).replace(str(self._staging.folder), self._remote.name)) from error
        episodes = set(chosen)
        if (self._root / SUBSET).is_file() and not self._is_given_up:  # else the numbers may be those of others
            episodes |= set(read_subset(self._root).episodes)
        files = files_of(self._staging.folder, sorted(episodes))
        lost = files - there.keys()
        if lost:
            raise DatasetError(f"{self._remote.name} is not whole: {listed(lost)} are missing there.")
        return Subset(sorted(episodes), files)

    def _is_complete(self, wanted: set[str], same: set[str], note: SubsetNote | None) -> bool:
        is_noted = (self._root / SUBSET).exists()
        return wanted <= same and (read_subset(self._root) == note if is_noted else note is None)

    def _compare(self, folder: Path, paths: Sequence[str], there: Mapping[str, RemoteFile]) -> set[str]:
        """Return which files are the listed ones."""
        found: set[str] = set()

        def compare(path: str) -> None:
            if is_whole(folder / path, there[path]):
                found.add(path)

        run_all(compare, paths, _HASHERS)
        self._by_size |= {path for path in found if there[path].digest is None}
        return found


def _problem(root: Path) -> str:
    """Return why a dataset is not sound; nothing if it is."""
    try:
        load_state(root)
    except DatasetError as error:
        return str(error)
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        return f"its metadata contradict themselves ({error!r})"
    return ""
