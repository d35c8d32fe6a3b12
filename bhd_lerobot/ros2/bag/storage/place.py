"""Where bags and the datasets made of them are written: they come to their place complete, or not at all."""

import contextlib
from collections.abc import Iterator
from pathlib import Path

from bhd_lerobot.datasets.storage.atomic import building, complete_interrupted, is_free, real, remove_abandoned
from bhd_lerobot.datasets.storage.disk import Disk, write_errors
from bhd_lerobot.errors import DatasetExistsError


def refuse_existing(target: Path, option: str) -> None:
    """Check that nothing is at a place yet, but perhaps an empty folder; first complete what was decided there."""
    if target.is_symlink() and not target.exists():
        raise DatasetExistsError(f"{target} is a broken link. Remove it, or choose another {option}.")
    remove_abandoned(real(target))  # a name such as ``new/..`` is no name for a folder beside it
    complete_interrupted(target)
    if not is_free(target):
        raise DatasetExistsError(f"{target} exists already. Remove it, or choose another {option}.")


@contextlib.contextmanager
def complete_or_not(target: Path, option: str, action: str, consequence: str) -> Iterator[Path]:
    """Give a path at which something is to be made, which takes its place in one step when the block ends well.

    It lies in a hidden folder beside the place, locked as long as this process lives. What an exception leaves there is
    removed at once, what a kill leaves there by the next attempt.

    Args:
        target: its place; nothing may be there but an empty folder.
    """
    with (
        write_errors(action, target, consequence),
        building(target, Disk(), lambda: refuse_existing(target, option)) as space,
    ):
        yield space.folder  # its final name, which rosbag2 gives to the files in it
