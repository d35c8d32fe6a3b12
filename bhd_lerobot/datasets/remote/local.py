"""The dataset on this machine while it is copied: whole, finalised, and the same until the copy is complete."""

import contextlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from bhd_lerobot.datasets.format.state import DatasetState, load_state
from bhd_lerobot.datasets.remote.listing import is_recorded
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.datasets.storage.atomic import complete_interrupted, has_unfinished_episodes
from bhd_lerobot.datasets.storage.disk import RootLock
from bhd_lerobot.datasets.storage.places import check_inside
from bhd_lerobot.datasets.storage.pointers import check_fetched, pulled_in_part
from bhd_lerobot.errors import DatasetError, DatasetLockedError, brief, quoted

_SKIPPED = {layout.SUBSET, layout.UNREPORTED}


@dataclass(frozen=True)
class LocalDataset:
    """A valid dataset on this machine: its files by path; those `left_out` belong to no episode and are not copied."""

    root: Path
    state: DatasetState
    files: dict[str, Path]
    left_out: list[str]
    _stamps: dict[str, tuple[int, ...]]

    def check_unchanged(self) -> None:
        """Check that nothing was written since the dataset was opened."""
        now = _stamps(self.root)
        if changed := {name for name in now | self._stamps if now.get(name) != self._stamps.get(name)}:
            raise DatasetError(
                f"{self.root} was changed by another program while it was being copied: {brief(sorted(changed))}. What "
                "was sent is not shown to anybody. Wait until the other program ends."
            )


@contextmanager
def open_local(root: Path) -> Iterator[LocalDataset]:
    """Open a dataset for copying, and keep other programs of ours from writing it meanwhile."""
    if not root.is_dir():
        raise DatasetError(f"{root} is not a LeRobot dataset: it does not exist.")
    try:
        complete_interrupted(root)
        lock = RootLock(root, is_shared=True)
    except DatasetLockedError as error:
        raise DatasetLockedError(
            f"{root} is in use: it is being recorded, repaired or edited by another process. Wait until that ends."
        ) from error
    with contextlib.closing(lock):
        stamps = _stamps(root)
        if (root / layout.SUBSET).exists():
            raise pulled_in_part(root)
        check_fetched(root)
        state = load_state(root)
        if not state.num_episodes:
            raise DatasetError(f"{root} has no episode, so there is nothing to copy. Record some with bhd-record.")
        without = state.identity is not None and (state.without_stats or not (root / layout.STATS).is_file())
        if has_unfinished_episodes(root) or without:
            reason = "it has no statistics" if without else "its recording was interrupted"
            raise DatasetError(f"{root} is not finalised: {reason}. Run bhd-data repair {quoted(root)}.")
        if unseen := sorted(state.files() - stamps.keys()):
            raise DatasetError(
                f"{root}: {brief(sorted(unseen))} lie behind a link to a folder, which is not followed. Copy the "
                "dataset with `cp -rL`, and take the copy."
            )
        left_out = sorted(name for name in stamps if is_recorded(name) and name not in state.files())
        names = sorted(stamps.keys() - {*left_out, *_SKIPPED})
        # `images` is LeRobot's own folder, of frames whose video is not encoded yet. Notes are checked like all files.
        files = {name: root / name for name in names if not name.startswith("images/")}
        for path in files.values():
            check_inside(root, path)
        yield LocalDataset(root, state, files, left_out, stamps)


def _stamps(root: Path) -> dict[str, tuple[int, ...]]:
    """Return size, time of change and inode of every file that is not hidden, by its path."""
    found: dict[str, tuple[int, ...]] = {}
    for folder, folders, names in os.walk(root):
        folders[:] = [name for name in folders if not name.startswith(".")]
        for path in (Path(folder, name) for name in names if not name.startswith(".")):
            if path.is_file():
                with contextlib.suppress(FileNotFoundError):  # it was removed just now: the comparison notices
                    stat = path.stat()
                    found[path.relative_to(root).as_posix()] = (stat.st_size, stat.st_mtime_ns, stat.st_ino)
    return found
