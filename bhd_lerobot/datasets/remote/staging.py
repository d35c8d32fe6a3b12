"""The folder beside a dataset in which a download comes together, and how it takes the dataset's place."""

import contextlib
import os
import shutil
import stat
from pathlib import Path

from bhd_lerobot.datasets.assembly.assemble import EDITS
from bhd_lerobot.datasets.remote.listing import SUBSET, is_recorded
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.datasets.storage.atomic import PULL, is_fixed, move_in, note_done, uninterrupted
from bhd_lerobot.datasets.storage.disk import Disk
from bhd_lerobot.errors import DatasetError

_MARKER = ".bhd-pull"
"""In folders beside the target that this program made, and may remove."""

_OURS = {_MARKER, SUBSET, EDITS, layout.INFO, layout.STATS, layout.TASKS, layout.IDENTITY, layout.UNREPORTED}
"""Files of a dataset, besides those that `is_recorded` recognises."""


class Staging:
    """A folder beside a dataset; `is_new` is whether it was made now."""

    def __init__(self, root: Path) -> None:
        """Make the folder, or take up that of an attempt before."""
        self._root = root
        # Where nothing can be put beside the dataset, its staging folder is the place.
        self.folder = folder = root / PULL if is_fixed(root) else root.with_name(f".{root.name}.pull")
        self.is_new = not os.path.lexists(folder)
        if not self.is_new and not _is_ours(folder):
            raise DatasetError(
                f"{folder} is in the way: bhd-data pull needs this name temporarily and did not create it. Move it, or "
                "choose another --root."
            )
        if root.is_dir():
            (root / _MARKER).unlink(missing_ok=True)  # of a pull that was killed as soon as it was done
        folder.mkdir(parents=True, exist_ok=True)
        (folder / _MARKER).touch()

    def link(self, path: str) -> None:
        """Link a file of the dataset into the folder, in the place of what an attempt for another version left."""
        (self.folder / path).unlink(missing_ok=True)
        _link(self._root / path, self.folder / path)

    def clear(self, kept: set[str]) -> None:
        """Remove all files but some."""
        for path in sorted(self.folder.rglob("*"), reverse=True):
            if path.is_dir():
                with contextlib.suppress(OSError):  # it is not empty
                    path.rmdir()
            elif path.relative_to(self.folder).as_posix() not in {*kept, _MARKER}:
                path.unlink()

    def drop(self) -> None:
        """Remove the folder and all that is in it."""
        shutil.rmtree(self.folder, ignore_errors=True)
        if self.folder == self._root / PULL:
            with contextlib.suppress(OSError):
                self.folder.parent.rmdir()

    def publish(self, wanted: set[str], note: bytes | None) -> None:
        """Let the folder become the dataset; what belongs to no dataset comes along from the one before."""
        root, folder = self._root, self.folder
        if root.is_dir():
            folder.chmod(root.stat().st_mode & 0o7777)  # the permissions stay the same
        self.clear(wanted)
        if note is not None:
            (folder / SUBSET).write_bytes(note)
        with uninterrupted():
            if not root.is_dir() or not any(root.iterdir()):
                Disk().move(folder, root)
                note_done(f"{root} had been pulled")
            else:
                names = {path.name for path in folder.iterdir()}
                # What lies in none of these folders stays where it is.
                for path in (path for name in names for path in (root / name).rglob("*")):
                    inside = path.relative_to(root).as_posix()
                    is_foreign = inside not in wanted | _OURS and not is_recorded(inside)
                    if is_foreign and (path.is_symlink() or not path.is_dir()):
                        _link(path, folder / inside)
                move_in(folder, root, Disk(), done=f"{root} had been pulled", goes={"data", "videos"} - names)
            (root / _MARKER).unlink(missing_ok=True)


def _is_ours(folder: Path) -> bool:
    """Return whether a pull made this folder: in a place that is everybody's, another user could change it later."""
    about = folder.lstat()
    is_own = stat.S_ISDIR(about.st_mode) and about.st_uid == os.geteuid()
    return is_own and ((folder / _MARKER).exists() or not any(folder.iterdir()))


def _link(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(source, target, follow_symlinks=False)
    except OSError:
        shutil.copy2(source, target, follow_symlinks=False)
