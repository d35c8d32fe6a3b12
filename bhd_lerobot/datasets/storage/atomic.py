"""Atomic publishing: new content for a folder is in place completely or not at all, whenever its process is killed.

A new folder is made in a hidden folder beside its place and renamed once.

Of an existing dataset the folders `meta`, `data` and `videos` are replaced; the folder itself, files of other programs
and mount points stay. The new folders are made in the staging folder. Then a marker is written, with which the change
is decided, and each new folder is swapped with the old one: atomically, or with two renames where the file system has
no atomic swap. All of this is flushed to the device: what it replaces may have been there for long, and a power failure
shall not take it away. A kill in between leaves old and new folders side by side. Every command that finds the marker
completes the change first and reports it. Stock LeRobot does not know the marker and would mix the folders; therefore
``info.json`` has an invalid version until all of them are in place.
"""

import contextlib
import errno
import glob
import json
import logging
import os
import re
import shutil
import signal
import tempfile
import threading
from collections.abc import Callable, Collection, Iterator
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.datasets.storage.disk import Disk, RootLock, to_json, write_errors
from bhd_lerobot.errors import ConfigError, DatasetCorruptError, DatasetLockedError

WORK = Path(layout.STAGING, "compact")
PULL = Path(layout.STAGING, "pull")  # downloads, if nothing can be put beside their place
_WORKSPACES = {WORK.name, PULL.name}
_MARKER, _INVALID = WORK / "ready", WORK / "info.json"
_LONGEST = 240  # bytes of a name, to which a random part is added
_NO_SWAP = (errno.EINVAL, errno.ENOSYS, errno.EOPNOTSUPP)
_ORDER = {"data": 1, "meta": 2}  # the metadata last, other folders first
UNFINISHED_VERSION = "a change was interrupted; complete it with: bhd-data repair"
"""`codebase_version` meanwhile. LeRobot refuses a dataset with an invalid version and shows this text."""


class Workspace:
    """A hidden folder in which content is made before it is published.

    It is locked while this process lives. `close` removes it after an exception, the next workspace of the same place
    after a kill.

    Attributes:
        place: where the content is published, without symbolic links.
        folder: the content; it has the name of the place and does not exist yet.
    """

    def __init__(self, place: Path, disk: Disk, lock: RootLock | None = None) -> None:
        """Make the folder; a change that was interrupted is completed first."""
        self.place = place = real(place)
        self._disk, self._is_new = disk, lock is None
        self._is_inside = lock is not None or bool(_names(place)) or is_fixed(place)
        # Only one process may move something into a folder.
        self._lock = RootLock(place) if self._is_new and self._is_inside else None
        self._shell_lock: RootLock | None = None
        self._shell = place / WORK / "build"
        try:
            if self._is_inside:
                roll_forward(place)
                disk.remove_tree(place / WORK)
                disk.make_folder(self._shell)
            else:
                disk.make_folder(place.parent)
                remove_abandoned(place)
                self._shell, self._shell_lock = _make_shell(place)
        except BaseException:
            self.close()
            raise
        self.folder = self._shell / place.name

    def lock_new(self) -> RootLock:
        """Make the folder, and return a lock that is going to be that of the place; for something new."""
        self._disk.make_folder(self.folder)
        if self._lock is None:
            return RootLock(self.folder, shown_as=self.place)
        lock, self._lock = self._lock, None
        return lock

    def publish(self, done: str, goes: Collection[str] = ()) -> None:
        """Move the folder to its place, or its content to the places of the same names; names that `goes` has go, too.

        Signals that would end the process wait until it is done.
        """
        if self._is_inside:
            move_in(self.folder, self.place, done=done, is_new=self._is_new, goes=goes)
            return
        with uninterrupted():
            self._disk.move(self.folder, self.place)  # fails if another program has created it meanwhile
            note_done(done)

    def close(self) -> None:
        """Remove the workspace and all that is left in it; a second call does nothing."""
        if self._is_inside:
            _clean_inside(self.place)
        else:
            shutil.rmtree(self._shell, ignore_errors=True)
        for lock in (self._lock, self._shell_lock):
            if lock is not None:
                lock.release()

    def __enter__(self) -> "Workspace":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


@contextlib.contextmanager
def building(target: Path, disk: Disk, refuse: Callable[[], None]) -> Iterator[Workspace]:
    """Give a workspace for something new, and publish it when the block ends well."""
    remove_abandoned(real(target))
    complete_interrupted(target)
    refuse()
    with Workspace(target, disk) as space:
        token = _done.set(None)  # changes in the workspace are not in force yet
        try:
            yield space
        finally:
            _done.reset(token)
        refuse()
        space.publish(f"{target} had been made")


def move_in(new: Path, place: Path, *, done: str, is_new: bool = False, goes: Collection[str] = ()) -> None:
    """Move the content of a folder to the places of the same names in another one, which the caller has locked.

    Signals that would end the process wait until it is done.

    Args:
        done: the result, a sentence without a full stop; see `noting_what_is_done`.
        is_new: nothing may be at these places.
    """
    work, disk, device = place / WORK, Disk(), Disk(fsync=True)
    if not new.is_relative_to(work):
        disk.remove_tree(work)
        disk.make_folder(work)
    _check_movable(place, [*_names(new), *goes], is_new)
    with uninterrupted():
        try:  # from the marker on there are only renames, which a full disk allows
            disk.make_folder(work / "old")
            if (new / layout.INFO).is_file():
                _write_invalid_info(place, disk)
            disk.move(new, work / "new")
            device.flush_tree(work / "new")
            inodes = {name: (work / "new" / name).lstat().st_ino for name in _names(work / "new")}
            plan = {"root": place.stat().st_ino, "new": inodes, "goes": sorted(goes), "is_new": is_new}
            device.write(work / "ready.tmp", json.dumps(plan).encode())
            device.move(work / "ready.tmp", place / _MARKER)
        except BaseException:
            with contextlib.suppress(OSError):
                (work / "new").rename(new)
            raise
        sentences = _done.get()
        before = None if sentences is None else list(sentences)
        note_done(f"the change of {place} is committed, and the next command completes it")
        with _decided(place):
            roll_forward(place)
        if sentences is not None and before is not None:
            sentences[:] = [*before, done]


def is_free(place: Path) -> bool:
    """Return whether something can be made at a place: it is missing or an empty folder.

    The folder `lost+found` of a file system and leftovers of a killed attempt in a staging folder do not count.
    """
    if not place.exists():
        return not place.is_symlink()
    if not place.is_dir() or is_decided(place):
        return False
    nothing = {"lost+found"} if real(place) in _mounts() else set()
    if not has_unfinished_episodes(place):
        nothing.add(layout.STAGING)
    return _names(place) <= nothing


def refuse_inside(target: Path, source: Path) -> None:
    """Refuse to write into a dataset that is only read: it would be uploaded and checked with it."""
    if real(source) in real(target).parents:
        raise ConfigError(f"{target} lies in {source}, which must not change. Choose a folder outside it.")


def remove_abandoned(place: Path) -> None:
    """Remove the workspaces that killed processes left beside a place, or in it; those of living ones are locked."""
    ours = re.compile(re.escape(_prefix(place)) + "[a-z0-9_]{8}")  # as `tempfile` names them
    for folder in place.parent.glob(f"{glob.escape(_prefix(place))}*"):
        if ours.fullmatch(folder.name):
            with contextlib.suppress(OSError, DatasetLockedError), contextlib.closing(RootLock(folder)):
                shutil.rmtree(folder)
    if os.path.isdir(place / layout.STAGING) and _kept(place) <= {WORK.name}:
        with contextlib.suppress(OSError, DatasetLockedError), contextlib.closing(RootLock(place)):
            _clean_inside(place)


def clean(place: Path) -> None:
    """Remove what killed processes left of content that never came to its place; the caller has locked the place."""
    remove_abandoned(real(place))
    _clean_inside(place)


def has_unfinished_episodes(root: Path) -> bool:
    """Return whether a staging folder holds episodes that a recorder has not saved.

    That is anything but workspaces, and files that were being written to replace another one.
    """
    return bool(_kept(root) - _WORKSPACES)


def is_decided(place: Path) -> bool:
    """Return whether a change was decided and not completed."""
    return os.path.isfile(place / _MARKER)


def roll_forward(place: Path) -> bool:
    """Complete a change that had been decided; return whether there was one. The caller has locked the place."""
    if not is_decided(place):
        return False
    plan, disk, device = _read_plan(place), Disk(), Disk(fsync=True)
    new, old = place / WORK / "new", place / WORK / "old"
    disk.make_folder(old)
    for name in plan.goes:
        if os.path.lexists(place / name):
            disk.move(place / name, _unused(old / name))
    if (place / _INVALID).is_file() and not _is_there(place / "meta", plan.new.get("meta")):
        device.move(place / _INVALID, place / layout.INFO)
    for name in sorted({*_names(new), *plan.new}, key=lambda name: (_ORDER.get(name, 0), name)):
        _replace(new / name, place / name, old / name, plan, disk)
    for folder in (place, old):
        device.flush_folder(folder)
    disk.remove(place / _MARKER)
    disk.try_remove_tree(place / WORK)
    with contextlib.suppress(OSError):
        (place / layout.STAGING).rmdir()
    return True


def complete_interrupted(place: Path) -> bool:
    """Complete a change that a killed process had decided, log it, and return whether there was one."""
    if not is_decided(place):
        return False
    lock = RootLock(place)
    try:
        with _decided(place), uninterrupted():
            was_there = roll_forward(place)
    finally:
        lock.release()
    if was_there:
        logging.getLogger(__name__).warning(
            "%s: completed a change that had been interrupted while its files were moved in.", place
        )
    return was_there


def link_others(
    old: Path, new: Path, disk: Disk, *replaced: str, take: Callable[[Path, Path], None] | None = None
) -> None:
    """Link everything below `old` into `new`, but the files that match `replaced`; or `take` it in another way."""
    disk.make_folder(new)
    skipped = {path for pattern in replaced for path in old.glob(pattern)}
    for path in sorted(old.rglob("*")):
        if path.is_file() and path not in skipped:
            disk.make_folder((new / path.relative_to(old)).parent)
            (take or disk.link)(path, new / path.relative_to(old))


# --- a change ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Plan:
    """The content of the marker: inodes of the new content by name, names that are removed, whether places are free."""

    new: dict[str, int]
    goes: tuple[str, ...]
    is_new: bool


def _read_plan(place: Path) -> _Plan:
    """Read the marker. It may come from a copied dataset, so it is valid only in the folder in which it was written."""
    staging = place / layout.STAGING
    if any(path.is_symlink() for path in (staging, *(place / WORK / name for name in ("", "ready", "new", "old")))):
        raise _foreign_marker(place)
    try:
        values = json.loads((place / _MARKER).read_bytes())
        plan = _Plan(
            {str(k): int(v) for k, v in values["new"].items()}, tuple(map(str, values["goes"])), values["is_new"]
        )
        is_own = values["root"] == place.stat().st_ino
    except (ValueError, TypeError, KeyError, AttributeError):
        raise _foreign_marker(place) from None
    if not is_own or any(name in ("", ".", "..") or "/" in name for name in (*plan.new, *plan.goes)):
        raise _foreign_marker(place)
    return plan


def _foreign_marker(place: Path) -> DatasetCorruptError:
    return DatasetCorruptError(
        f"{place / WORK} holds a change that was interrupted in another folder, or a forged marker; it is not "
        "completed here. If this is a copy of a dataset, complete the change in the original and copy that; or move "
        f"{place / layout.STAGING} away, and run `bhd-data check` on the rest."
    )


def _replace(new: Path, target: Path, old: Path, plan: _Plan, disk: Disk) -> None:
    """Move one entry of the new content to its place, wherever a kill has left it and the entry that it replaces."""
    if _is_there(target, plan.new.get(new.name)):
        if os.path.lexists(new):  # the old content, after a swap
            disk.move(new, _unused(old))
        return
    if not os.path.lexists(new):
        return
    if not os.path.lexists(target):
        disk.move(new, target)
        return
    if plan.is_new:
        raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(target))
    try:
        disk.swap(new, target)
        disk.move(new, _unused(old))
    except OSError as error:
        if error.errno not in _NO_SWAP:
            raise
        disk.move(target, _unused(old))
        disk.move(new, target)


def _is_there(path: Path, inode: int | None) -> bool:
    return inode is not None and os.path.lexists(path) and path.lstat().st_ino == inode


def _unused(path: Path) -> Path:
    number = 1
    while os.path.lexists(path):
        path, number = path.with_name(f"{path.name.partition('~')[0]}~{number}"), number + 1
    return path


def _write_invalid_info(place: Path, disk: Disk) -> None:
    """Write the ``info.json`` with which LeRobot refuses a dataset while its folders are swapped."""
    try:
        content = json.loads((place / layout.INFO).read_bytes())
        content["codebase_version"] = UNFINISHED_VERSION
    except (OSError, ValueError, TypeError):
        return  # no program can load it anyhow
    disk.write(place / _INVALID, to_json(content))


def _check_movable(place: Path, names: Collection[str], is_new: bool) -> None:
    """Check that a change can be carried out, before it is decided."""
    mounts = _mounts()
    for name in names:
        path = place / name
        if not os.path.lexists(path):
            continue
        number = 0
        if is_new:
            number = errno.EEXIST
        elif any(path == mount or path in mount.parents for mount in mounts):
            number = errno.EBUSY  # its content would be removed as that of the dataset
        elif path.is_dir() and not path.is_symlink() and not os.access(path, os.W_OK):
            number = errno.EACCES
        if number:
            raise OSError(number, os.strerror(number), str(path))


def _clean_inside(place: Path) -> None:
    if not is_decided(place) and not (place / layout.STAGING).is_symlink():
        Disk().try_remove_tree(place / WORK)
        with contextlib.suppress(OSError):
            for name in _names(place / layout.STAGING) - _kept(place):
                (place / layout.STAGING / name).unlink()
            (place / layout.STAGING).rmdir()


# --- signals ----------------------------------------------------------------------------------------------------------

_done: ContextVar[list[str] | None] = ContextVar("done", default=None)


@contextlib.contextmanager
def noting_what_is_done() -> Iterator[list[str]]:
    """Collect what came into force in the block, sentences without a full stop, for the last message of a command."""
    sentences: list[str] = []
    token = _done.set(sentences)
    try:
        yield sentences
    finally:
        _done.reset(token)


def note_done(sentence: str) -> None:
    """Note what has come into force; see `noting_what_is_done`."""
    if (sentences := _done.get()) is not None:
        sentences.append(sentence)


@contextlib.contextmanager
def uninterrupted() -> Iterator[None]:
    """Let Ctrl-C and the signals that end a process wait until the block has ended."""
    if threading.current_thread() is not threading.main_thread():
        yield  # Python handles signals in the main thread only
        return
    waiting: list[int] = []
    former: dict[signal.Signals, Any] = {}

    def wait(number: int, frame: FrameType | None) -> None:
        waiting.append(number)

    for signum in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(signum) is not None:  # None: installed by C code, which cannot be restored
            former[signum] = signal.signal(signum, wait)
    try:
        yield
    finally:
        for signum, handler in former.items():
            signal.signal(signum, handler)
    for number in waiting[:1]:  # an error ends the command anyway, with a better message
        signal.raise_signal(number)


# --- parts ------------------------------------------------------------------------------------------------------------


def real(path: Path) -> Path:
    """Return a path without symbolic links; unlike with `Path.resolve`, a link to itself is no error."""
    return Path(os.path.realpath(path))


def is_fixed(place: Path) -> bool:
    """Return whether a folder, given without symbolic links, cannot be replaced: its content must be moved in."""
    if not place.is_dir():
        return False
    with contextlib.suppress(FileNotFoundError):  # the current folder may have been removed
        current = Path.cwd()
        if (
            current == place or place in current.parents
        ):  # the current folder of this process, and of its shell, would be gone
            return True
    is_long = len(os.fsencode(_prefix(place))) > _LONGEST
    return is_long or place in _mounts() or not os.access(place.parent, os.W_OK | os.X_OK)


def _mounts() -> set[Path]:
    """Return all mount points, also of folders of the same file system, which `os.path.ismount` does not see."""
    try:
        lines = Path("/proc/self/mountinfo").read_bytes().splitlines()
    except OSError:
        return set()
    places = (line.split(b" ")[4] for line in lines)
    return {Path(os.fsdecode(re.sub(rb"\\([0-7]{3})", lambda m: bytes([int(m[1], 8)]), place))) for place in places}


def _make_shell(place: Path) -> tuple[Path, RootLock]:
    """Make a hidden folder beside a place and lock it."""
    while True:
        shell = Path(tempfile.mkdtemp(prefix=_prefix(place), dir=place.parent))
        with contextlib.suppress(FileNotFoundError, DatasetLockedError):  # another process that cleans up was quicker
            return shell, RootLock(shell, shown_as=place)


def _prefix(place: Path) -> str:
    return f".{place.name}.bhd-"


def _kept(place: Path) -> set[str]:
    """Return what is in a staging folder, but for the files that `Disk.publish` did not come to rename."""
    return {name for name in _names(place / layout.STAGING) if not (name.startswith(".") and name.endswith(".part"))}


def _names(folder: Path) -> set[str]:
    return set(os.listdir(folder)) if folder.is_dir() else set()


@contextlib.contextmanager
def _decided(place: Path) -> Iterator[None]:
    """Add to an error that the next command completes the change."""
    consequence = "The change is committed, and the next command completes it."
    with write_errors("complete a change", place, consequence):
        yield
