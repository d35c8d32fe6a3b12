"""New content for a folder, which takes its place in one step that a kill cannot leave half done.

It is made in a hidden folder beside the place. Where nothing is at the place, a rename puts it there; where a dataset
is, the two folders exchange their names, which Linux does in one step, so that nobody ever sees something between the
old content and the new one.

Where that cannot be had (a mount point, a folder whose parent cannot be written, a file system without an exchange of
names, the current folder of this process), the content is moved piece by piece: a marker is written first, and from
there on the move is decided. Every command that finds the marker completes the move, and says so.
"""

import contextlib
import errno
import glob
import logging
import os
import shutil
import signal
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from pathlib import Path
from types import FrameType
from typing import Any, Literal

from bhd_lerobot.data import layout
from bhd_lerobot.data.disk import Disk, RootLock, write_errors
from bhd_lerobot.errors import ConfigError, DatasetLockedError

WORK = Path(layout.STAGING, "compact")  # the name that versions before had, so that what they left is found
PULL = Path(layout.STAGING, "pull")  # where a download comes together, if nothing can be put beside its place
_WORKSPACES = {WORK.name, PULL.name}
_MARKER = WORK / "ready"
_LONGEST = 240  # bytes of a name, to which a random part is added
_NO_EXCHANGE = (errno.EINVAL, errno.ENOSYS, errno.EOPNOTSUPP, errno.EBUSY, errno.EXDEV, errno.EPERM, errno.EACCES)


class Workspace:
    """A hidden folder in which something is made before it takes its place.

    It is locked while this process lives. What an exception leaves in it is removed by `close`, what a kill leaves by
    the next workspace of the same place.

    Attributes:
        place: where the content is going to lie, without symbolic links.
        folder: what is going to lie there; it does not exist yet, and has the name of the place.
    """

    def __init__(self, place: Path, disk: Disk, lock: RootLock | None = None) -> None:
        """Make the folder; a move of new content that was interrupted is completed first.

        Args:
            place: a folder, or where one is going to be made.
            disk: how to write.
            lock: of the dataset that is there, some folders of which are going to be replaced; it holds the new one
                afterwards. None if something new is made.

        Raises:
            DatasetLockedError: another process makes something in this folder.
            OSError: nothing can be written there.
        """
        self.place = place = real(place)
        self._disk, self._replaced = disk, lock
        self._is_inside = must_be_inside(place)
        # Only one process may move something into a folder piece by piece.
        is_moved_in = self._is_inside or bool(_names(place))
        self._lock = RootLock(place) if lock is None and is_moved_in else None
        self._shell_lock: RootLock | None = None
        self._shell = place / WORK / "build"
        try:
            if lock is not None or self._lock is not None:
                roll_forward(place, disk)
            if self._is_inside:
                disk.remove_tree(place / WORK)
                disk.make_folder(self._shell)
            else:
                disk.make_folder(place.parent)
                remove_abandoned(place)
                self._shell = Path(tempfile.mkdtemp(prefix=_prefix(place), dir=place.parent))
                self._shell_lock = RootLock(self._shell, shown_as=place)
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

    def publish(self, done: str) -> None:
        """Let the folder take its place, as `publish` says."""
        replaced: Replaced = "nothing" if self._replaced is None else "parts"
        publish(self.folder, self.place, self._disk, done=done, replaced=replaced, lock=self._replaced)

    def close(self) -> None:
        """Remove the workspace and all that is left in it; a second call does nothing."""
        shutil.rmtree(self._shell, ignore_errors=True)
        for folder in (self.place / WORK, self.place / layout.STAGING) if self._is_inside else ():
            with contextlib.suppress(OSError):
                folder.rmdir()
        for lock in (self._lock, self._shell_lock):
            if lock is not None:
                lock.release()

    def __enter__(self) -> "Workspace":
        """Return the workspace itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Remove it."""
        self.close()


@contextlib.contextmanager
def making(target: Path, disk: Disk, refuse: Callable[[], None]) -> Iterator[Workspace]:
    """Give a workspace for something new, and publish it when the block ends well.

    Args:
        target: its place.
        disk: how to write.
        refuse: raises if something is at the place; called before and after the block.
    """
    remove_abandoned(real(target))
    complete_interrupted(target)
    refuse()
    with Workspace(target, disk) as space:
        token = _done.set(None)  # what is done in the workspace is not in force yet
        try:
            yield space
        finally:
            _done.reset(token)
        refuse()
        space.publish(f"{target} had been made")


type Replaced = Literal["nothing", "parts", "all"]
"""What new content replaces: nothing, the parts of a dataset that have the same names, or all that is there."""


def publish(new: Path, place: Path, disk: Disk, *, done: str, replaced: Replaced, lock: RootLock | None = None) -> None:
    """Let a folder take its place, or what is in it the places of the same names.

    Signals that would end the process wait until it is done.

    Args:
        new: the folder, on the same file system.
        place: where it is going to lie.
        disk: how to write.
        done: what has been done then, a sentence without a full stop; see `noting_what_is_done`.
        replaced: what of that which is there.
        lock: of the dataset that is there, which is going to be that of the new one; None if the new folder is locked.

    Raises:
        OSError: it could not be done; what is at the place is as it was.
        DatasetWriteError: it could not be completed, and will be by the next command.
    """
    is_inside = must_be_inside(place)
    with uninterrupted():
        if not is_inside and not _names(place):
            disk.move(new, place)
        elif is_inside or replaced == "nothing" or not _exchange(new, place, disk, replaced, lock):
            _move_in(new, place, disk, replaced)
        if (sentences := _done.get()) is not None:
            sentences.append(done)


def is_free(place: Path) -> bool:
    """Tell whether something can be made at a place: nothing is there, or an empty folder.

    What a file system has at its root, and what a killed attempt left in a staging folder, is nothing.
    """
    if not place.exists():
        return not place.is_symlink()
    if not place.is_dir() or is_decided(place):
        return False
    nothing = {"lost+found"} if os.path.ismount(place) else set()
    if not has_unfinished_episodes(place):
        nothing.add(layout.STAGING)
    return _names(place) <= nothing


def refuse_inside(target: Path, source: Path) -> None:
    """Refuse to write into a dataset that is only read: it would be uploaded and checked with it.

    Raises:
        ConfigError: `target` lies in `source`.
    """
    if real(source) in real(target).parents:
        raise ConfigError(f"{target} lies in {source}, which is to stay as it is. Choose a place beside it.")


def remove_abandoned(place: Path) -> None:
    """Remove the workspaces that killed processes left beside a place, or in it; those of living ones are locked."""
    for folder in place.parent.glob(f"{glob.escape(_prefix(place))}*"):
        with contextlib.suppress(OSError, DatasetLockedError):
            RootLock(folder).release()
            shutil.rmtree(folder)
    if (place / WORK).exists():
        with contextlib.suppress(OSError, DatasetLockedError):
            lock = RootLock(place)
            _clean_inside(place)
            lock.release()


def clean(place: Path) -> None:
    """Remove what killed processes left of content that never came to its place; the caller has locked the place."""
    remove_abandoned(real(place))
    _clean_inside(place)


def has_unfinished_episodes(root: Path) -> bool:
    """Tell whether there is something in a staging folder that is no workspace: what a recorder has not saved."""
    return bool(_names(root / layout.STAGING) - _WORKSPACES)


def is_decided(place: Path) -> bool:
    """Tell whether new content was being moved in when its process was killed."""
    return (place / _MARKER).exists()


def roll_forward(place: Path, disk: Disk) -> bool:
    """Complete a move that had been decided; return whether there was one. The caller has locked the place."""
    if not is_decided(place):
        return False
    new, old = place / WORK / "new", place / WORK / "old"
    disk.make_folder(old)
    for name in filter(None, os.fsdecode((place / _MARKER).read_bytes()).split("\0")):
        if os.path.lexists(place / name):
            disk.move(place / name, old / name)
    # Without its metadata it is no dataset, so they come last.
    for name in sorted(_names(new), key=lambda name: (name == "meta", name == "data", name)):
        # If the old one is gone already, the kill came between these two renames.
        if os.path.lexists(place / name):
            disk.move(place / name, old / name)
        disk.move(new / name, place / name)
    disk.remove(place / _MARKER)
    disk.try_remove_tree(place / WORK)
    with contextlib.suppress(OSError):
        (place / layout.STAGING).rmdir()
    return True


def complete_interrupted(place: Path) -> bool:
    """Complete a move that a killed process had decided, and say so; for everybody who is about to read a dataset.

    Returns:
        Whether there was one.

    Raises:
        DatasetLockedError: the process lives.
        DatasetWriteError: it cannot be completed.
    """
    if not is_decided(place):
        return False
    lock = RootLock(place)
    try:
        with _decided(place), uninterrupted():
            was_there = roll_forward(place, Disk())
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


def _clean_inside(place: Path) -> None:
    if not is_decided(place):
        Disk().try_remove_tree(place / WORK)
        with contextlib.suppress(OSError):
            (place / layout.STAGING).rmdir()


# --- both ways of replacing -------------------------------------------------------------------------------------------


def _exchange(new: Path, old: Path, disk: Disk, replaced: Replaced, lock: RootLock | None) -> bool:
    """Exchange the names of two folders and remove what is the old one then; return False if that cannot be done."""
    others = [old / name for name in sorted(_others(old, new))] if replaced == "parts" else []
    try:
        for path in others:
            _link_tree(path, new / path.name, disk)
        _copy_attributes(old, new)
        handle = None if lock is None else lock.open(new)
    except OSError:
        _drop(new, others)
        return False
    try:
        disk.swap(new, old)
    except OSError as error:
        if handle is not None:
            os.close(handle)
        _drop(new, others)
        if error.errno in _NO_EXCHANGE:
            return False
        raise
    if lock is not None and handle is not None:
        lock.replace(handle)
    # From here on the new content is in force. What somebody put among the rest in the meantime comes along.
    new, old = old, new
    with contextlib.suppress(OSError):
        for name in _others(old, new) if replaced == "parts" else ():
            (old / name).rename(new / name)
    if not old.parent.name.startswith(_prefix(new)):
        # A folder that goes on to be used after a kill: what is being removed must not be taken for what is in it.
        with contextlib.suppress(OSError):
            aside = Path(tempfile.mkdtemp(prefix=_prefix(new), dir=new.parent))
            old = old.rename(aside / "old").parent
    disk.try_remove_tree(old)
    return True


def _move_in(new: Path, place: Path, disk: Disk, replaced: Replaced) -> None:
    """Move what is in a folder to the place, piece by piece; from the marker on it is decided."""
    work = place / WORK
    if not new.is_relative_to(work):
        disk.remove_tree(work)
        disk.make_folder(work)
    goes = sorted(_others(place, new)) if replaced == "all" else []
    disk.move(new, work / "new")
    try:
        disk.write(work / "ready.tmp", os.fsencode("\0".join(goes)))
        disk.move(work / "ready.tmp", place / _MARKER)
    except BaseException:
        _clean_inside(place)
        raise
    with _decided(place):
        roll_forward(place, disk)


def _others(old: Path, new: Path) -> set[str]:
    """Return what is in a dataset and not in its new content."""
    kept = {"lost+found"} if os.path.ismount(old) else set()
    return _names(old) - _names(new) - kept - {layout.STAGING}


def _copy_attributes(old: Path, new: Path) -> None:
    """Let the same people look into a folder."""
    shutil.copystat(old, new)
    owner = old.stat()
    os.chown(new, owner.st_uid, owner.st_gid)


def _drop(new: Path, others: list[Path]) -> None:
    """Remove the links to what stays, so that the folder holds only what is new."""
    for path in others:
        link = new / path.name
        if link.is_dir() and not link.is_symlink():
            shutil.rmtree(link)
        else:
            link.unlink(missing_ok=True)


# --- signals ----------------------------------------------------------------------------------------------------------

_done: ContextVar[list[str] | None] = ContextVar("done", default=None)


@contextlib.contextmanager
def noting_what_is_done() -> Iterator[list[str]]:
    """Collect what came into force in the block, sentences without a full stop, for who says how a command ended."""
    sentences: list[str] = []
    token = _done.set(sentences)
    try:
        yield sentences
    finally:
        _done.reset(token)


@contextlib.contextmanager
def uninterrupted() -> Iterator[None]:
    """Let Ctrl-C and the signals that end a process wait until the block has ended."""
    if threading.current_thread() is not threading.main_thread():
        yield  # Python handles signals in the main thread, which is elsewhere
        return
    waiting: list[int] = []
    former: dict[signal.Signals, Any] = {}

    def wait(number: int, frame: FrameType | None) -> None:
        waiting.append(number)

    for one in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(one) is not None:  # None: installed by another language, which nobody could restore
            former[one] = signal.signal(one, wait)
    try:
        yield
    finally:
        for one, handler in former.items():
            signal.signal(one, handler)
        for number in waiting[:1]:
            signal.raise_signal(number)


# --- parts ------------------------------------------------------------------------------------------------------------


def real(path: Path) -> Path:
    """Return a path without symbolic links; unlike `Path.resolve`, one that leads to itself is no error here."""
    return Path(os.path.realpath(path))


def _prefix(place: Path) -> str:
    return f".{place.name}.bhd-"


def _names(folder: Path) -> set[str]:
    return set(os.listdir(folder)) if folder.is_dir() else set()


def must_be_inside(place: Path) -> bool:
    """Tell whether a folder cannot be renamed, so that its new content must be made in it."""
    if not place.is_dir():
        return False
    current = Path.cwd()
    is_current = current == place or place in current.parents  # a shell, too, would stand in a folder that is gone
    is_long = len(os.fsencode(_prefix(place))) > _LONGEST
    return is_current or is_long or os.path.ismount(place) or not os.access(place.parent, os.W_OK | os.X_OK)


def _link_tree(source: Path, target: Path, disk: Disk) -> None:
    """Give a file a second name, or every file of a folder.

    Raises:
        OSError: it cannot have one, or it is neither a file nor a folder nor a link.
    """
    if source.is_symlink():
        target.symlink_to(os.readlink(source))
    elif source.is_dir():
        if os.path.ismount(source):
            raise OSError(errno.EXDEV, os.strerror(errno.EXDEV), str(source))
        target.mkdir()
        for path in sorted(source.iterdir()):
            _link_tree(path, target / path.name, disk)
        shutil.copystat(source, target)
    elif source.is_file():
        disk.hard_link(source, target)
    else:
        raise OSError(errno.EINVAL, os.strerror(errno.EINVAL), str(source))


@contextlib.contextmanager
def _decided(place: Path) -> Iterator[None]:
    """Say of an error that the move goes on as soon as its cause is removed."""
    consequence = "The change is decided, and the next command completes it."
    with write_errors("complete a change", place, consequence):
        yield
