"""Copy a dataset from the Hub or from below a URL; from the Hub, also the files of some episodes only.

Everything goes into a folder beside the target first, is checked there, and becomes the dataset by a rename. What an
interrupted download from the Hub leaves is in that folder, and the next attempt resumes it.
"""

import contextlib
import filecmp
import json
import os
import shutil
import stat
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from bhd_lerobot.datasets.assembly.assemble import EDITS
from bhd_lerobot.datasets.format.state import load_state
from bhd_lerobot.datasets.remote.listing import (
    RemoteFile,
    is_recorded,
    matching,
    megabytes,
    parse_info,
)
from bhd_lerobot.datasets.remote.store import Remote, refuse_overlap
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.datasets.storage.atomic import (
    PULL,
    Workspace,
    clean,
    complete_interrupted,
    has_unfinished_episodes,
    is_fixed,
    is_free,
)
from bhd_lerobot.datasets.storage.disk import Disk, RootLock, to_json, write_errors
from bhd_lerobot.datasets.storage.places import wrong_path
from bhd_lerobot.errors import BhdError, ConfigError, DatasetError, DatasetExistsError, TransferError, brief, quoted

type Select = Callable[[Path], Sequence[int]]
"""Chooses episodes, given a folder that holds the metadata of the dataset."""

_SPARE_BYTES = 1 << 20
_MARKER = ".bhd-pull"
"""In folders beside the target that this program made, and may remove."""

_OURS = {layout.SUBSET, EDITS, layout.INFO, layout.STATS, layout.TASKS, layout.IDENTITY, layout.UNREPORTED}
"""Files of a dataset, besides those that `is_recorded` recognises."""


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
    with contextlib.ExitStack() as stack:
        stack.enter_context(write_errors("pull the dataset", root, "The dataset itself was not changed."))
        complete_interrupted(root)
        there = _files(remote)
        folder = stack.enter_context(_download_folder(root, is_kept=remote.has_checksums))
        lock = stack.enter_context(contextlib.closing(RootLock(root))) if root.is_dir() else None
        return _Pull(remote, root, there, folder, lock).run(select, replace)


class _Pull:
    def __init__(
        self, remote: Remote, root: Path, there: dict[str, RemoteFile], folder: Path, lock: RootLock | None
    ) -> None:
        self._remote, self._root, self._there, self._folder, self._lock = remote, root, there, folder, lock
        self._fetched: set[str] = set()
        self._same: set[str] = set()  # what the root has already
        self._is_given_up = False  # what lies at the root, for what comes

    def run(self, select: Select | None, replace: bool) -> PullReport:
        there, name, is_hub = self._there, self._remote.name, self._remote.has_checksums
        if self._lock is not None:
            clean(self._root)
        self._check_target()
        if is_hub:
            self._compare(replace)
        self._get([layout.INFO])  # whether it is a dataset at all is known before everything is fetched
        info = parse_info((self._folder / layout.INFO).read_bytes(), name)
        if not is_hub:
            self._get(there)
            self._compare(replace)
        episodes, wanted = None, set(there)
        if select is not None:
            wanted = {path for path in there if not is_recorded(path) or path.startswith("meta/")} | self._same
            self._get(wanted)
            episodes, files = self._wanted(select)
            wanted |= files
        self._get(wanted)
        is_whole = all(path in wanted for path in there if is_recorded(path))
        note = None if episodes is None or is_whole else to_json({"source": name, "episodes": episodes})
        before = (self._root / layout.SUBSET).read_bytes() if (self._root / layout.SUBSET).exists() else None
        if not wanted <= self._same or note != before:
            self._publish(wanted, note)
        return PullReport(
            root=self._root,
            episodes=episodes,
            is_whole=is_whole,
            total_episodes=info["total_episodes"],
            fetched=sorted(self._fetched),
            fetched_bytes=sum(there[path].size for path in self._fetched),
            kept=len(wanted) - len(self._fetched),
            problem=_problem(self._root) if is_whole else "",
        )

    def _check_target(self) -> None:
        root = self._root
        if root.exists() and not root.is_dir():
            raise DatasetExistsError(f"{root} is a file. Choose another folder with --root.")
        if has_unfinished_episodes(root):
            raise DatasetExistsError(
                f"{root} is a recording that was interrupted. Run bhd-data repair {quoted(root)}, or choose another "
                "--root."
            )
        if not is_free(root) and not (root / layout.INFO).is_file():
            raise DatasetExistsError(f"{root} exists and is no dataset. Choose another folder with --root.")

    def _compare(self, replace: bool) -> None:
        """Find out what need not be fetched because `root` has it; refuse a root that holds something else."""
        present = {path: self._root / path for path in self._there if (self._root / path).is_file()}
        if self._remote.has_checksums:
            self._same = matching(present, self._there)
        else:
            self._same = {path for path in present if filecmp.cmp(present[path], self._folder / path, shallow=False)}
        changed = (present.keys() - self._same) | (layout.recorded_files(self._root) - self._there.keys())
        if changed and not replace:
            raise DatasetExistsError(
                f"{self._root} holds another dataset, or was changed since it was pulled: {brief(sorted(changed))}. "
                "Choose another folder with --root, or replace it with --replace."
            )
        self._is_given_up = bool(changed)

    def _get(self, paths: Collection[str]) -> None:
        """Bring files into the folder: from the root, from an earlier attempt, or from the remote place."""
        folder, there, missing = self._folder, self._there, set(paths) - self._same - self._fetched
        for path in self._same & set(paths):
            (folder / path).unlink(missing_ok=True)
            _link(self._root / path, folder / path)
        if not missing:
            return
        left = [path for path in missing if not RemoteFile(there[path].size).matches(folder / path)]
        need, free = sum(there[path].size for path in left), shutil.disk_usage(folder).free
        if need + _SPARE_BYTES > free:
            raise TransferError(
                f"Could not download {self._remote.name}: {megabytes(need)} are missing, and the disk of {folder} "
                f"has {megabytes(free)} free. Free some space, or name another --root."
            )
        self._remote.fetch(sorted(missing), folder)
        # Not hashed again, which takes as long as a fast download: TLS and Xet check the content on its way.
        if wrong := [path for path in missing if (folder / path).stat().st_size != there[path].size]:
            raise TransferError(f"Could not download {self._remote.name}: {brief(sorted(wrong))} did not arrive whole.")
        self._fetched |= missing

    def _wanted(self, select: Select) -> tuple[list[int], set[str]]:
        """Return the chosen episodes, with those that were chosen before, and the files that hold them."""
        name = self._remote.name
        state = load_state(self._folder, files=False)
        try:
            chosen = {int(index) for index in select(self._folder)}
        except DatasetError as error:
            raise type(error)(str(error).replace(str(self._folder), name)) from error
        if unknown := sorted(episode for episode in chosen if not 0 <= episode < state.num_episodes):
            raise DatasetError(
                f"There is no episode {', '.join(map(str, unknown[:5]))}; {name} has {state.num_episodes}, from 0 to "
                f"{state.num_episodes - 1}."
            )
        if not self._is_given_up:  # else the numbers may be those of others
            chosen |= {episode for episode in _episodes_before(self._root) if 0 <= episode < state.num_episodes}
        files = state.files(sorted(chosen))
        if lost := files - self._there.keys():
            raise DatasetError(f"{name} is incomplete: {brief(sorted(lost))} are missing there.")
        return sorted(chosen), files

    def _publish(self, wanted: set[str], note: bytes | None) -> None:
        """Let the wanted files become the dataset; what belongs to no dataset comes along from the one before."""
        root, disk = self._root, Disk()
        is_new = is_free(root)
        if is_new and self._lock is not None:
            self._lock.release()
        with Workspace(root, disk, None if is_new else self._lock) as space:
            for path in wanted:
                (space.folder / path).parent.mkdir(parents=True, exist_ok=True)
                os.replace(self._folder / path, space.folder / path)
            if note is not None:
                (space.folder / layout.SUBSET).write_bytes(note)
            names = {path.name for path in space.folder.iterdir()}
            for former in (file for name in names for file in (root / name).rglob("*")):
                inside = former.relative_to(root).as_posix()
                is_foreign = inside not in wanted | _OURS and not is_recorded(inside)
                if is_foreign and (former.is_symlink() or not former.is_dir()):
                    _link(former, space.folder / inside)
            space.publish(f"{root} had been pulled", goes={"data", "videos"} - names)


@contextlib.contextmanager
def _download_folder(root: Path, *, is_kept: bool) -> Iterator[Path]:
    """Give the locked folder beside a dataset in which a download comes together; what a failure leaves may be kept."""
    # Where nothing can be put beside the dataset, its staging folder is the place.
    folder = root / PULL if is_fixed(root) else root.with_name(f".{root.name}.pull")
    is_new = not os.path.lexists(folder)
    if not is_new:
        about = folder.lstat()  # in a place that is everybody's, another user could change it later
        is_own = stat.S_ISDIR(about.st_mode) and about.st_uid == os.geteuid()
        if not is_own or not ((folder / _MARKER).exists() or not any(folder.iterdir())):
            raise DatasetError(
                f"{folder} is in the way: bhd-data pull needs this name temporarily and did not create it. Move it, or "
                "choose another --root."
            )
    folder.mkdir(parents=True, exist_ok=True)
    (folder / _MARKER).touch()
    is_useful = False  # for the next attempt
    with contextlib.closing(RootLock(folder, root)):
        try:
            if not is_kept:
                _clear(folder)
            yield folder
        except BaseException as error:
            is_refusal = isinstance(error, BhdError) and not isinstance(error, TransferError)
            is_useful = is_kept and not (is_new and is_refusal)
            raise
        finally:
            if not is_useful:
                with contextlib.suppress(OSError):
                    _clear(folder)
                    shutil.rmtree(folder)  # the marker last: after a kill it is still known as ours
                    if folder == root / PULL:
                        folder.parent.rmdir()


def _clear(folder: Path) -> None:
    for path in folder.iterdir():
        if path.is_dir():
            shutil.rmtree(path)
        elif path.name != _MARKER:
            path.unlink()


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
    return {path: file for path, file in there.items() if path[0] != "." and path != layout.SUBSET}


def _episodes_before(root: Path) -> list[int]:
    """Return the episodes that were requested before; none without a note, or if it cannot be read."""
    try:
        return [int(one) for one in json.loads((root / layout.SUBSET).read_bytes())["episodes"]]
    except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError):
        return []


def _problem(root: Path) -> str:
    try:
        load_state(root)
    except DatasetError as error:
        return str(error)
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        return f"its metadata contradict themselves ({error!r})"
    return ""


def _link(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(source, target, follow_symlinks=False)
    except OSError:
        shutil.copy2(source, target, follow_symlinks=False)
