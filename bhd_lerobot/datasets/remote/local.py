"""The dataset on this machine while it is copied: whole, finalised, and the same until the copy is complete."""

import contextlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bhd_lerobot.datasets.format.state import DatasetState, load_state
from bhd_lerobot.datasets.remote.listing import MANIFEST, SUBSET, Item, is_recorded, listed
from bhd_lerobot.datasets.remote.subset import is_subset
from bhd_lerobot.datasets.storage import layout
from bhd_lerobot.datasets.storage.atomic import complete_interrupted, has_unfinished_episodes
from bhd_lerobot.datasets.storage.disk import RootLock
from bhd_lerobot.datasets.storage.places import check_inside
from bhd_lerobot.datasets.storage.pointers import check_fetched
from bhd_lerobot.errors import DatasetError, DatasetLockedError, quoted

_TEMPORARY = ("images",)  # LeRobot's own, of frames whose video is not encoded yet


@dataclass(frozen=True)
class LocalDataset:
    """A valid dataset on this machine; what is `left_out` belongs to no episode, and is not copied."""

    root: Path
    state: DatasetState
    items: list[Item]
    left_out: list[str]
    _stamps: dict[str, tuple[int, ...]]

    @property
    def info(self) -> Item:
        """Return its `meta/info.json`."""
        return next(item for item in self.items if item.path == layout.INFO)

    def check_unchanged(self) -> None:
        """Check that nothing was written since the dataset was opened."""
        now = _stamps(self.root)
        changed = {name for name in now.keys() | self._stamps.keys() if now.get(name) != self._stamps.get(name)}
        if changed:
            raise DatasetError(
                f"{self.root} was changed by another program while it was being copied: {listed(changed)}. What was "
                "sent is not shown to anybody. Wait until the other program ends."
            )


@contextmanager
def open_local(root: Path) -> Iterator[LocalDataset]:
    """Open a dataset for copying, and keep other programs of ours from writing it meanwhile."""
    if not root.is_dir():
        raise DatasetError(f"{root} is not a LeRobot dataset: it does not exist.")
    try:
        complete_interrupted(root)
        lock = RootLock(root)
    except DatasetLockedError as error:
        raise DatasetLockedError(
            f"{root} is in use: it is being recorded, repaired or copied by another process. Wait until that ends."
        ) from error
    try:
        stamps = _stamps(root)
        if is_subset(root):
            raise DatasetError(
                f"{root} holds some episodes of a dataset only: it was pulled with --episodes or --outcome. Pull all "
                "of it first, or make a dataset of its own of these episodes."
            )
        check_fetched(root)
        state = load_state(root)
        _refuse_unfinished(state)
        names, left_out = _files(state, stamps)
        items = [Item(name, root / name, stamps[name][0]) for name in names]
        yield LocalDataset(root, state, items, left_out, stamps)
    finally:
        lock.release()


def _refuse_unfinished(state: DatasetState) -> None:
    root = state.root
    if not state.num_episodes:
        raise DatasetError(f"{root} has no episode, so there is nothing to copy. Record some with bhd-record.")
    if has_unfinished_episodes(root):
        raise DatasetError(
            f"{root} is not finalised: its recording was interrupted. Run bhd-data repair {quoted(root)}."
        )
    if state.identity is not None and (state.without_stats or not (root / layout.STATS).is_file()):
        raise DatasetError(f"{root} is not finalised: it has no statistics. Run bhd-data repair {quoted(root)}.")


def _files(state: DatasetState, stamps: dict[str, Any]) -> tuple[list[str], list[str]]:
    """Return the files that belong to the dataset, and those that have names of its layout and belong to no episode."""
    needed = state.files()
    if unseen := sorted(needed - stamps.keys()):
        raise DatasetError(
            f"{state.root}: {listed(unseen)} lie behind a link to a folder, which is not followed. Copy the dataset "
            "with `cp -rL`, and take the copy."
        )
    left_out = sorted(name for name in stamps if is_recorded(name) and name not in needed)
    skipped = {*left_out, SUBSET, MANIFEST, layout.UNREPORTED}
    names = [name for name in sorted(stamps) if name not in skipped and name.split("/")[0] not in _TEMPORARY]
    for name in names:  # notes beside the dataset, too: a listing does not show that a file is only linked there
        check_inside(state.root, state.root / name)
    return names, left_out


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
