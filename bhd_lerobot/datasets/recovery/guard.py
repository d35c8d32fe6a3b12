"""When a dataset must not be salvaged though it looks like a wreck: it is in use, or the disk does not give it out."""

import contextlib
import os
from pathlib import Path
from typing import NoReturn

from bhd_lerobot.datasets.storage.places import check_links
from bhd_lerobot.errors import DatasetError, DatasetLockedError

_BLOCK = 1 << 20


def check_unused(root: Path) -> None:
    """Check that no other process has a file below `root` open: LeRobot takes no lock.

    Raises:
        DatasetLockedError: one has.
    """
    own, place = str(os.getpid()), root.resolve()
    for process in Path("/proc").glob("[0-9]*"):
        if process.name == own:
            continue
        with contextlib.suppress(OSError):  # ended meanwhile, or somebody else's
            for handle in (process / "fd").iterdir():
                with contextlib.suppress(OSError):
                    target = Path(os.readlink(handle))
                    if target != place and place in target.parents:
                        raise DatasetLockedError(
                            f"Process {process.name} has {target} open, so {root} may be in the middle of a "
                            "recording. Wait until it ends; without its last files a running recording looks like a "
                            "wreck."
                        )


def check_readable(root: Path) -> None:
    """Check that the disk gives out every byte below `root`.

    A file that may not be read, or not at this moment, is not damaged: its episodes would be given up for nothing.

    Raises:
        DatasetError: it refuses, or a link leads out of the dataset.
    """
    check_links(root)

    def refuse(error: OSError) -> NoReturn:
        raise DatasetError(
            f"{error.filename or root} cannot be read: {error.strerror or error}. Such a file is not recovered, for "
            "it may be whole: check its permissions and the disk, and repeat. Nothing was changed."
        ) from error

    for folder, _, names in os.walk(root, onerror=refuse):
        for name in sorted(names):
            path = Path(folder, name)
            if path.is_symlink() and not path.exists():
                continue  # it leads nowhere: the file is missing
            try:
                with open(path, "rb", buffering=0) as file:
                    while file.read(_BLOCK):
                        pass
            except OSError as error:
                refuse(OSError(error.errno, error.strerror, str(path)))
