"""Every change that the recorder makes on disk, one small step at a time.

All writing goes through `Disk`, so that durability, error messages and the order of steps can be judged in one place,
and so that a test can stop the process before any single step.
"""

import contextlib
import ctypes
import errno
import fcntl
import json
import os
import shutil
import stat
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from bhd_lerobot.errors import DatasetLockedError, DatasetWriteError

_REMEDIES = {
    errno.ENOSPC: "Free some space on this disk.",
    errno.EDQUOT: "Your disk quota is used up; free some space.",
    errno.EFBIG: "The file-size limit of this process or file system is reached (see `ulimit -f`).",
    errno.EACCES: "Check the permissions of this path.",
    errno.EPERM: "Check the permissions of this path.",
    errno.EROFS: "The file system is mounted read-only; choose another root.",
    errno.ENOTDIR: "A part of this path is a file, not a folder; choose another root.",
    errno.EMFILE: "Too many files are open in this process (see `ulimit -n`).",
}


# Linux's own numbers.
_FICLONE = 0x40049409  # let both files have the same blocks until one of them is written
_AT_FDCWD, _RENAME_EXCHANGE = -100, 2

_NO_FLUSH = (errno.EINVAL, errno.EBADF, errno.ENOSYS, errno.EOPNOTSUPP)
"""What file systems answer that cannot flush a folder, such as those that a virtual machine shares with its host."""


def _before_step(action: str, path: Path) -> None:
    """Do nothing; called before every change of the disk. Tests replace it to end the process there."""


class Disk:
    """File-system steps with one policy for flushing and one for errors.

    Args:
        fsync: flush every file and folder to the device before the step counts as done. Without it an episode
            survives the death of the process (the kernel holds the pages), but not a power failure.
    """

    def __init__(self, fsync: bool = False) -> None:
        self.fsync = fsync

    def make_folder(self, path: Path) -> None:
        """Create `path` and its parents; an existing folder is fine."""
        if path.is_dir():
            return
        missing = path
        while not missing.exists() and not missing.parent.is_dir():
            missing = missing.parent
        if missing.exists():
            raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR), str(missing))
        _before_step("mkdir", path)
        path.mkdir(parents=True, exist_ok=True)
        while path != missing.parent:
            path = path.parent
            self.flush_folder(path)

    def write(self, path: Path, content: bytes | memoryview) -> None:
        """Write a new file. `path` must be a staging path: a kill leaves it half written."""
        _before_step("open", path)
        with open(path, "wb", buffering=0) as file:
            view = memoryview(content)
            half = len(view) // 2
            # Two calls, so that a test can stop between them and leave a torn file, as a real kill can.
            for end in (half, len(view)):
                _before_step("write", path)
                while file.tell() < end:
                    file.write(view[file.tell() : end])
            if self.fsync:
                os.fsync(file.fileno())

    def flush(self, path: Path) -> None:
        """Flush a file that another library wrote, if flushing is on."""
        if self.fsync:
            with open(path, "rb") as file:
                os.fsync(file.fileno())

    def flush_tree(self, folder: Path) -> None:
        """Flush every new file below a folder, and every folder, if flushing is on; further names of files are old."""
        for place, _, names in os.walk(folder, topdown=False):
            for path in (Path(place, name) for name in names):
                about = path.lstat()
                if stat.S_ISREG(about.st_mode) and about.st_nlink == 1:
                    self.flush(path)
            self.flush_folder(Path(place))

    def move(self, source: Path, target: Path) -> None:
        """Rename a file or folder; an existing target file is replaced in one step."""
        _before_step("rename", target)
        os.replace(source, target)
        self.flush_folder(target.parent)

    def publish(self, path: Path, content: bytes, staging: Path | None = None) -> None:
        """Write a file beside its place, or in a staging folder, and rename it: it is there completely or as before."""
        folder = staging or path.parent
        self.make_folder(folder)
        part = folder / f".{path.name}.part"
        self.write(part, content)
        self.move(part, path)

    def swap(self, first: Path, second: Path) -> None:
        """Swap two folders atomically."""
        _before_step("swap", second)
        function = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None)
        if function is None:
            raise OSError(errno.ENOSYS, os.strerror(errno.ENOSYS), str(second))
        if function(_AT_FDCWD, os.fsencode(first), _AT_FDCWD, os.fsencode(second), _RENAME_EXCHANGE) != 0:
            number = ctypes.get_errno()
            raise OSError(number, os.strerror(number), str(first), None, str(second))
        for folder in {first.parent, second.parent}:
            self.flush_folder(folder)

    def link(self, source: Path, target: Path) -> None:
        """Give a file a second name, or copy it where the file system cannot do that."""
        _before_step("link", target)
        try:
            os.link(source.resolve(), target)  # not a link to a link, which would point nowhere from its new place
        except OSError:
            # FAT and some network file systems have no hard links. A real failure shows again in the copy.
            shutil.copy2(source, target)
            self.flush(target)

    def copy(self, source: Path, target: Path) -> None:
        """Copy a file; where the file system can, without copying its blocks."""
        _before_step("copy", target)
        with open(source, "rb") as old, open(target, "wb") as new:
            try:
                fcntl.ioctl(new, _FICLONE, old.fileno())
            except OSError:
                shutil.copyfileobj(old, new, 1 << 20)
        self.flush(target)

    def remove(self, path: Path) -> None:
        """Remove a file; a missing one is fine."""
        _before_step("unlink", path)
        path.unlink(missing_ok=True)

    def remove_tree(self, path: Path) -> None:
        """Remove a folder and all below it; a missing one is fine."""
        if not path.exists():
            return
        _before_step("rmtree", path)
        shutil.rmtree(path)

    def try_remove_tree(self, path: Path) -> None:
        """Remove a folder that is not needed any more; what cannot be removed stays for a later command."""
        with contextlib.suppress(OSError):
            self.remove_tree(path)

    def flush_folder(self, path: Path) -> None:
        """Flush a folder, if flushing is on: what is in it, and under which name."""
        if self.fsync:
            handle = os.open(path, os.O_RDONLY)
            try:
                os.fsync(handle)
            except OSError as error:
                if error.errno not in _NO_FLUSH:
                    raise
            finally:
                os.close(handle)


def to_json(content: Mapping[str, Any]) -> bytes:
    """Return `content` as indented JSON text, the way LeRobot writes its own files."""
    return json.dumps(content, indent=4, ensure_ascii=False).encode()


@contextlib.contextmanager
def write_errors(action: str, root: Path, consequence: str) -> Iterator[None]:
    """Turn an operating-system error into a `DatasetWriteError` with the failed action and the state of the dataset."""
    try:
        yield
    except OSError as error:
        # ffmpeg's errors carry an errno of their own; a missing one still has a readable message.
        reason = os.strerror(error.errno) if error.errno is not None and error.errno in errno.errorcode else str(error)
        where = error.filename2 or error.filename or root
        remedy = _REMEDIES.get(error.errno or 0, "")
        text = f"Could not {action} in {root}: {reason} ({where}). {remedy} {consequence}"
        raise DatasetWriteError(" ".join(text.split())) from error


class RootLock:
    """Ownership of a dataset root, held until `release` or the end of the process.

    The lock is taken on the folder itself, so no lock file is left behind for an upload to pick up.

    Args:
        root: the folder.
        shown_as: the place that it will have.
        is_choice: whether another root may be chosen.
        is_shared: whether others may read it at the same time, and nobody writes; else it is of this process alone.
    """

    def __init__(
        self, root: Path, shown_as: Path | None = None, *, is_choice: bool = False, is_shared: bool = False
    ) -> None:
        self._root, self._shown_as, self._is_choice = root, shown_as or root, is_choice
        self._kind = fcntl.LOCK_SH if is_shared else fcntl.LOCK_EX
        self._handle: int | None = None
        self.acquire()

    def acquire(self) -> bool:
        """Take the lock if it is not held; return whether it was taken now."""
        if self._handle is not None:
            return False
        handle = os.open(self._root, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            fcntl.flock(handle, self._kind | fcntl.LOCK_NB)
        except OSError as error:
            os.close(handle)
            if isinstance(error, BlockingIOError):
                raise DatasetLockedError(
                    f"{self._shown_as} is being recorded, repaired, edited or copied by another process. Wait until it "
                    f"ends{', or choose another root' if self._is_choice else ''}."
                ) from None
            raise DatasetWriteError(
                f"{self._shown_as} cannot be locked: {error.strerror}. Its file system has no locks, which keep two "
                "programs from writing a dataset at once; put it on a local disk."
            ) from error
        self._handle = handle
        # The folder may be renamed while it is locked; a second time it is taken under its final name.
        self._root = self._shown_as
        return True

    def close(self) -> None:
        """Give the lock back, as `release` does; for `contextlib.closing`."""
        self.release()

    def release(self) -> None:
        """Give the lock back; a second call does nothing."""
        if self._handle is not None:
            # Unlocked explicitly: a forked child may still hold a copy of the handle.
            fcntl.flock(self._handle, fcntl.LOCK_UN)
            os.close(self._handle)
            self._handle = None
