"""The folder beside a dataset in which a download comes together, and how it takes the dataset's place."""

import contextlib
import os
import shutil
import stat
from collections.abc import Iterable
from pathlib import Path

from bhd_lerobot.datasets.assembly.assemble import EDITS
from bhd_lerobot.datasets.remote.listing import MANIFEST, SUBSET, is_recorded
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.datasets.storage.atomic import PULL, is_fixed, move_in, note_done, uninterrupted
from bhd_lerobot.datasets.storage.disk import Disk
from bhd_lerobot.errors import DatasetError

_MARKER = ".bhd-pull"
"""In folders beside the target that this program made, and may remove."""


class Staging:
    """A folder beside a dataset.

    Attributes:
        folder: where files come together; they stay there if an attempt fails.
        is_new: whether no attempt before left one.
    """

    def __init__(self, root: Path) -> None:
        """Make the folder, or take up that of an attempt before.

        Args:
            root: the dataset.

        Raises:
            DatasetError: something else lies where the folder must be.
        """
        self._root = root
        # Where nothing can be put beside the dataset, its staging folder is the place.
        self.folder = folder = root / PULL if is_fixed(root) else root.with_name(f".{root.name}.pull")
        is_empty = folder.is_dir() and not any(folder.iterdir())
        is_ours = is_empty or (folder / _MARKER).exists()
        if os.path.lexists(folder) and not (is_ours and _is_own(folder)):
            raise DatasetError(
                f"{folder} is in the way: bhd-data pull needs this name for a while, and did not make what is "
                "there. Move it, or choose another --root."
            )
        if root.is_dir():
            (root / _MARKER).unlink(missing_ok=True)  # of a pull that was killed as soon as it was done
        self.is_new = not self.folder.exists()
        self.folder.mkdir(parents=True, exist_ok=True)
        (self.folder / _MARKER).touch()

    def recover(self) -> None:
        """Undo what version 0.1 left when it was killed between two renames; who calls it has locked the folder."""
        old = self._root.with_name(f".{self._root.name}.old")
        if (old / _MARKER).is_file() and not self._root.exists() and _is_own(old):
            old.rename(self._root)
            (self._root / _MARKER).unlink(missing_ok=True)

    def take(self, path: str) -> None:
        """Link a file of the dataset into the folder, in the place of what an attempt for another version left."""
        (self.folder / path).unlink(missing_ok=True)
        _link(self._root / path, self.folder / path)

    def drop(self) -> None:
        """Remove the folder and all that is in it."""
        shutil.rmtree(self.folder, ignore_errors=True)
        self._tidy()

    def drop_if_empty(self) -> None:
        """Remove the folder if nothing came."""
        with contextlib.suppress(OSError):
            self.folder.rmdir()
        self._tidy()

    def _tidy(self) -> None:
        if self.folder == self._root / PULL:
            with contextlib.suppress(OSError):
                self.folder.parent.rmdir()

    def show(self, wanted: set[str], note: bytes | None) -> None:
        """Let the folder become the dataset; what belongs to no dataset comes along from the one before.

        Args:
            wanted: the files that the dataset is to have.
            note: content of `SUBSET`; no such file if None.
        """
        root, folder = self._root, self.folder
        if root.is_dir():
            folder.chmod(root.stat().st_mode & 0o7777)  # who may look into it stays the same
        shutil.rmtree(folder / ".cache", ignore_errors=True)
        _remove_others(folder, wanted)
        if note is not None:
            (folder / SUBSET).write_bytes(note)
        names = {path.name for path in folder.iterdir()}
        if not root.is_dir() or not any(root.iterdir()):
            with uninterrupted():
                Disk().move(folder, root)
                note_done(f"{root} had been pulled")
                (root / _MARKER).unlink(missing_ok=True)
            return
        # What is in none of these folders stays where it is.
        for path in _foreign(root, wanted):
            if (folder / Path(path).parts[0]).is_dir():
                _link(root / path, folder / path)
        with uninterrupted():
            move_in(folder, root, Disk(), done=f"{root} had been pulled", goes={"data", "videos", MANIFEST} - names)
            (root / _MARKER).unlink(missing_ok=True)


def _is_own(folder: Path) -> bool:
    """Tell whether a path is a folder of this user: in a place that is everybody's, another could change it later."""
    about = folder.lstat()
    return stat.S_ISDIR(about.st_mode) and about.st_uid == os.geteuid()


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
    ours = {
        *wanted,
        _MARKER,
        SUBSET,
        MANIFEST,
        EDITS,
        layout.INFO,
        layout.STATS,
        layout.TASKS,
        layout.IDENTITY,
        layout.UNREPORTED,
    }
    found: list[str] = []
    for place, folders, files in os.walk(root):
        inside = Path(place).relative_to(root)
        folders[:] = [n for n in folders if (inside / n).as_posix() not in (".cache/huggingface", layout.STAGING)]
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
