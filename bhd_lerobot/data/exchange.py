"""Other contents for a dataset, in one step that a kill cannot leave half done.

The new ``data``, ``videos`` and ``meta`` folders are built completely beside the old ones. Then a marker is written,
and from there on the folders are exchanged, each with two renames. A kill before the marker leaves the old dataset and
some rubbish in the staging folder; a kill after it is completed by `roll_forward` at the next open.
"""

from collections.abc import Callable
from pathlib import Path

from bhd_lerobot.data import layout
from bhd_lerobot.data.disk import Disk

WORK = Path(layout.STAGING, "compact")  # the name that versions before had, so that what they left is found
_MARKER = WORK / "ready"
_FOLDERS = ("videos", "data", "meta")


def begin(root: Path, disk: Disk) -> Path:
    """Return the empty place in which the new folders are to be built; a folder that is not built stays as it is."""
    disk.remove_tree(root / WORK)
    return root / WORK / "new"


def complete(root: Path, disk: Disk) -> None:
    """Put what was built since `begin` in place of the old folders."""
    disk.write(root / WORK / "ready.tmp", b"")
    disk.move(root / WORK / "ready.tmp", root / _MARKER)
    roll_forward(root, disk)


def is_decided(root: Path) -> bool:
    """Tell whether an exchange was interrupted after it had been decided."""
    return (root / _MARKER).exists()


def roll_forward(root: Path, disk: Disk) -> bool:
    """Complete an exchange that had been decided; return whether there was one."""
    if not is_decided(root):
        return False
    new, old = root / WORK / "new", root / WORK / "old"
    disk.make_folder(old)
    for name in _FOLDERS:
        if (new / name).exists():
            # If the old folder is gone already, the kill came between these two renames.
            if (root / name).exists():
                disk.move(root / name, old / name)
            disk.move(new / name, root / name)
    disk.remove(root / _MARKER)
    disk.remove_tree(root / WORK)
    return True


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
